"""A fit as files: fit.json names its arrays by their hash, identified.json is for people.

Whatever a fit consists of is covered by one checksum, and renaming fit.json is what puts a new fit
in the place of an old one: a process that dies before it leaves the old fit, and one that dies
after it the new one.
"""

import hashlib
import io
import json
from pathlib import Path

import numpy as np

from slipid.identify.fit_json import (
    BLOCKS,
    MATRICES,
    SCHEMA_FIT,
    from_json,
    identified_json,
    to_json,
)
from slipid.identify.result import Fit
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.files import checksum, json_text, read_json, write_bytes

FIT, IDENTIFIED = "fit.json", "identified.json"
_RESULT = "the result of `slipid identify`"


def save(fit: Fit, folder: Path) -> tuple[str, ...]:
    """Write a fit to a folder, in the place of the one that may be there; returns names of files.

    Raises:
        ValueError: a number is not finite; nothing is written then.
        DataError: nothing can be written there.
    """
    arrays = _packed(fit)
    sha256 = hashlib.sha256(arrays).hexdigest()
    name = f"fit-{sha256[:12]}.npz"
    content = to_json(fit) | {"arrays": {"file": name, "sha256": sha256}}
    content = json.loads(json_text(content))
    content |= {"checksum": checksum(content)}
    table = json_text(identified_json(fit))
    write_bytes(folder / name, arrays)
    write_bytes(folder / FIT, json_text(content).encode())  # from here on it is the new fit
    write_identified(folder, json.loads(table))
    for old in folder.glob("fit-????????????.npz"):
        if old.name != name:
            old.unlink()
    return IDENTIFIED, FIT, name


def write_identified(folder: Path, content: Content) -> None:
    """Write identified.json for the fit that is there, under whose checksum it is valid."""
    fit = read_json(folder / FIT, _RESULT)
    write_bytes(folder / IDENTIFIED, json_text(content | {"fit": fit["checksum"]}).encode())


def load(folder: Path) -> Fit:
    """Fit from the files `save` wrote.

    Raises:
        DataError: a file is absent, damaged, of another version or of another fit.
    """
    path = folder / FIT
    content = read_json(path, _RESULT)
    found = content.get("schema") if isinstance(content, dict) else None
    if found != SCHEMA_FIT:
        what = f"its schema is {found}" if isinstance(found, str) else "it has no schema"
        raise DataError(f"{path}: {what}; expected {SCHEMA_FIT}, {_RESULT} of this version")
    if content.pop("checksum", None) != (mark := checksum(content)):
        raise DataError(f"{path}: damaged or edited, its checksum differs; expected {_RESULT}")
    try:
        fit = from_json(content, _unpacked(folder, **content["arrays"]))
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"{path}: {error}; expected {_RESULT} of this version") from error
    table = folder / IDENTIFIED
    other = read_json(table, _RESULT) if table.exists() else {"fit": mark}
    if not isinstance(other, dict) or other.get("fit") != mark:
        raise DataError(
            f"{table}: of another fit than {FIT} beside it, its writing was interrupted; "
            "expected both of one fit (run `slipid identify` again)"
        )
    return fit


def _packed(fit: Fit) -> bytes:
    arrays = {name: getattr(fit, name) for name in MATRICES}
    for name in BLOCKS:
        arrays |= {f"{name}/{block}": v for block, v in getattr(fit, name).items()}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def _unpacked(folder: Path, file: str, sha256: str) -> dict[str, np.ndarray]:
    """The arrays of a fit; damage is noticed before they are decoded."""
    path = folder / file
    try:
        packed = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; expected the arrays of {FIT}") from error
    if hashlib.sha256(packed).hexdigest() != sha256:
        raise DataError(f"{path}: damaged, its hash differs from the one in {FIT}")
    with np.load(io.BytesIO(packed), allow_pickle=False) as npz:
        return {name: npz[name] for name in npz.files}
