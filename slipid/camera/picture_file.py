"""Image files, read as the sensor recorded them: orientation flags are reported, not applied."""

import re
import struct
from pathlib import Path

import numpy as np

from slipid.camera.opencv import MOST_PIXELS, cv2
from slipid.support.errors import DataError
from slipid.support.files import read_bytes

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")
"""File suffixes by which images are recognised in folders and next to videos; an image file that a
user gives directly for camera calibration may have any suffix."""
STORED_BITS = 12
"""Bits of cameras that are often stored in images of 16 bits without being scaled."""
ORIENTATION_TAG = 0x0112
_HEADER = re.compile(rb"(?:\A|Exif\0\0|eXIf|EXIF.{4}(?:Exif\0\0)?)(II\*\0|MM\0\*)", re.DOTALL)
"""Beginning of a TIFF file, or of the EXIF data in a JPEG, PNG or WebP file."""


def is_picture(path: Path) -> bool:
    """Return whether a file is an image, judged by its suffix."""
    return path.suffix.lower() in SUFFIXES


def pictures_in(folder: Path) -> list[Path]:
    """Return the images in a folder, sorted by name; raise `DataError` if there is none."""
    if paths := sorted(filter(is_picture, folder.iterdir())):
        return paths
    raise DataError(f"{folder}: no image; expected {', '.join(SUFFIXES)}")


def read_picture(path: Path, notes: list[str] | None = None) -> np.ndarray:
    """Return the image in a file, indexed by row, column and channel: blue, green, red, 0 to 255.

    Args:
        path: the file.
        notes: list to which a sentence is appended if the image has an orientation flag, unless the
            list already has sentences.

    Raises:
        DataError: the file is absent, empty, damaged or not an image, or has too many pixels; it is
            animated, or uses the lowest 12 bits of 16 alone.
    """
    data = read_bytes(path, "an image")
    if not data:
        raise DataError(f"{path}: the file is empty; expected an image (PNG, JPEG, ...)")
    if _is_animated(data):
        raise DataError(f"{path}: an animated image; expected an image of one frame, or a video")
    orientation, data = _without_orientation(data)
    try:
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        # OpenCV raises for images that are too large, and returns None for other unreadable files
        raise _too_large(path) from None
    if picture is None:
        raise DataError(
            f"{path}: not an image that OpenCV reads, or a damaged one; expected a PNG or JPEG file"
        )
    if picture.shape[0] * picture.shape[1] > MOST_PIXELS:
        raise _too_large(path)
    if picture.max() < 1 << (STORED_BITS - 8):
        stored = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_ANYDEPTH)
        if stored is not None and stored.dtype == np.uint16 and stored.any():
            raise DataError(
                f"{path}: an image of 16 bits whose largest value is {stored.max()}, as of a "
                f"camera with {STORED_BITS} bits or fewer, would be read as black; expected values "
                "up to 65535: multiply them, or save the image with 8 bits"
            )
    if orientation != 1 and notes == []:
        notes.append(
            f"{path}: its orientation flag (EXIF {orientation}) is not applied: the pixels are "
            "used as stored"
        )
    return np.asarray(picture)


def _is_animated(data: bytes) -> bool:
    """Return True for the data of a PNG or WebP file with several frames."""
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return b"acTL" in data[: max(data.find(b"IDAT"), 0)]
    return data[8:16] == b"WEBPVP8X" and data[20:21] != b"" and bool(data[20] & 2)


def _too_large(path: Path) -> DataError:
    return DataError(
        f"{path}: too large an image; expected {MOST_PIXELS // 10**6} million pixels at most"
    )


def _without_orientation(data: bytes) -> tuple[int, bytes]:
    """Return the EXIF orientation of an image file, 1 to 8, and data without it if it is a TIFF.

    OpenCV applies the orientation of TIFF files always.
    """
    header = _HEADER.search(data)
    if header is None:
        return 1, data
    order, start = "<" if header[1][:2] == b"II" else ">", header.start(1)
    try:
        at = start + int(struct.unpack_from(f"{order}I", data, start + 4)[0])
        for k in range(struct.unpack_from(f"{order}H", data, at)[0]):
            entry = at + 2 + 12 * k
            tag, _, _, value = struct.unpack_from(f"{order}HHIH", data, entry)
            if tag == ORIENTATION_TAG and 1 <= value <= 8:
                upright = struct.pack(f"{order}H", 1)
                tiff = data[: entry + 8] + upright + data[entry + 10 :] if start == 0 else data
                return value, tiff
    except struct.error:
        pass  # damaged metadata
    return 1, data
