"""Image files: orientation flags, damaged and huge headers."""

from __future__ import annotations

import struct
import subprocess
import sys
import zlib

import cv2
import numpy as np
import pytest

from slipid.camera import picture_file
from slipid.camera.picture_file import read_picture
from slipid.camera.video import still
from slipid.support.errors import DataError
from tests.helpers.made_boards import exif, write_flagged
from tests.helpers.track_command import LONE, ROBOT, STAGE, Made, track

STORED = np.arange(6 * 4 * 3, dtype=np.uint8).reshape(4, 6, 3)


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(orientation: int) -> bytes:
    data = cv2.imencode(".png", STORED)[1].tobytes()
    end = data.find(b"IDAT") - 4
    return data[:end] + chunk(b"eXIf", exif(orientation)) + data[end:]


def tiff(orientation: int) -> bytes:
    """Return an uncompressed TIFF file in red, green, blue."""
    pixels = STORED[..., ::-1].tobytes()
    start = 8 + len(pixels)
    tags = [(256, 3, 6), (257, 3, 4), (259, 3, 1), (262, 3, 2), (273, 4, 8)]
    tags += [(274, 3, orientation), (277, 3, 3), (278, 3, 4), (279, 4, len(pixels))]
    after = start + 2 + 12 * (len(tags) + 1) + 4
    entries = sorted([*((t, k, 1, v) for t, k, v in tags), (258, 3, 3, after)])
    directory = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    head = b"II*\0" + struct.pack("<I", start) + pixels
    return head + struct.pack("<H", len(entries)) + directory + struct.pack("<IHHH", 0, 8, 8, 8)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("kind", [png, tiff])
def test_pixels_are_those_stored_whatever_the_flag(kind, orientation, tmp_path):
    path = tmp_path / f"a.{kind.__name__}"
    path.write_bytes(kind(orientation))
    notes = []
    assert np.array_equal(read_picture(path, notes), STORED)
    expected = [f"a.{kind.__name__}: its orientation flag (EXIF {orientation}) is not applied"]
    assert [expected[0] in note for note in notes] == [True] * (orientation > 1)


def test_flagged_pictures_give_the_same_poses(tmp_path):
    made = Made(tmp_path)
    STAGE.camera.save(made.camera)
    for k in range(8):
        frame = STAGE.frame(k / 30, [ROBOT])
        data = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
        write_flagged(data, 1, tmp_path / "plain" / f"{k}.jpg")
        write_flagged(data, 1 + k, tmp_path / "flagged" / f"{k}.jpg")
    texts = []
    for name in ("plain", "flagged"):
        done = track(made, tmp_path / name, tmp_path / f"{name}.csv", *LONE, "--fps", 30)
        assert done.exit_code == 0, done.output
        texts.append(" ".join(done.output.split()))
    assert (tmp_path / "plain.csv").read_text() == (tmp_path / "flagged.csv").read_text()
    assert "orientation flag" not in texts[0]
    assert "1.jpg: its orientation flag (EXIF 2) is not applied" in texts[1]
    assert "EXIF 6" in still(tmp_path / "flagged" / "5.jpg").notes[0]


def test_damaged_metadata_are_no_flag(tmp_path):
    data = cv2.imencode(".jpg", STORED)[1].tobytes()
    for block in (b"II*\0", b"II*\0\xff\xff\xff\xff", b"MM\0*\0\0\0\x08\xff\xff", exif(9), exif(0)):
        inside = b"Exif\0\0" + block
        head = data[:2] + b"\xff\xe1" + struct.pack(">H", len(inside) + 2) + inside
        (tmp_path / "a.jpg").write_bytes(head + data[2:])
        notes = []
        assert read_picture(tmp_path / "a.jpg", notes).shape == STORED.shape
        assert notes == []


def header(width: int, height: int) -> bytes:
    """Return a PNG file that announces a size and has hardly any data."""
    size = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    rest = chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", size) + rest


def test_a_huge_picture_is_refused_by_its_header(tmp_path):
    """In a process of its own: the limit holds where slipid loads OpenCV."""
    (tmp_path / "a.png").write_bytes(header(20_000, 20_000))
    code = (
        "import resource, sys; from pathlib import Path\n"
        "resource.setrlimit(resource.RLIMIT_AS, (3_000_000_000, 3_000_000_000))\n"
        "from slipid.camera.picture_file import read_picture\n"
        "try: read_picture(Path(sys.argv[1]))\n"
        "except ValueError as error: print(error)"
    )
    words = [sys.executable, "-c", code, str(tmp_path / "a.png")]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert "a.png: too large an image; expected 200 million pixels at most" in done.stdout


def test_pictures_above_the_limit_or_damaged_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    for data in (header(0, 9), header(2**31 - 1, 2**31 - 1), header(400, 300), png(1)[:-40]):
        path.write_bytes(data)
        with pytest.raises(DataError, match=r"a\.png: (not an image|too large an image)"):
            read_picture(path)
    path.write_bytes(png(1))
    monkeypatch.setattr(picture_file, "MOST_PIXELS", 23)
    with pytest.raises(DataError, match="too large an image"):
        read_picture(path)


def test_animated_pictures_are_refused(tmp_path):
    from PIL import Image

    frames = [Image.fromarray(picture) for picture in (STORED, 255 - STORED)]
    for name in ("a.png", "a.webp"):
        frames[0].save(tmp_path / name, save_all=True, append_images=frames[1:])
        with pytest.raises(DataError, match=f"{name}: an animated image; expected"):
            read_picture(tmp_path / name)
        frames[0].save(tmp_path / name)
        assert read_picture(tmp_path / name).shape == STORED.shape


@pytest.mark.parametrize("suffix", [".png", ".tif", ".pgm"])
def test_values_of_12_bits_in_16_are_refused_and_16_bits_and_black_are_read(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    grey = np.arange(24, dtype=np.uint16).reshape(4, 6)
    cv2.imwrite(str(path), grey * 178)
    with pytest.raises(DataError, match="16 bits whose largest value is 4094, as of a camera"):
        read_picture(path)
    cv2.imwrite(str(path), grey * 2849)
    assert 250 <= read_picture(path).max() <= 255
    for black in (np.zeros((4, 6), np.uint16), np.full((4, 6), 9, np.uint8)):
        cv2.imwrite(str(path), black)
        assert read_picture(path).max() == black[0, 0]
