"""Reading and writing of files: atomic writes, strict JSON, and arrays without pickle."""

import hashlib
import io
import json
import os
import secrets
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from slipid.support.errors import DataError


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file atomically: after a crash, there is either the old or the new file.

    Raises:
        DataError: the file cannot be written.
    """
    partial = path.parent / f".{path.name}.{secrets.token_hex(4)}"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with partial.open("xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        raise DataError(
            f"{path}: cannot be written ({error.strerror}); expected a writable folder"
        ) from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def writable(folder: Path) -> None:
    """Make a folder and raise `DataError` if it is not writable.

    Call it before long work whose results will be written to the folder.
    """
    write_bytes(folder / ".writable", b"")
    (folder / ".writable").unlink()


def write_json(path: Path, value: object) -> None:
    """Write a JSON file; raise `ValueError` for numbers that are not finite."""
    write_bytes(path, json_text(value).encode())


def json_text(value: object) -> str:
    """Return the JSON text of plain values, numpy arrays and paths.

    Raises:
        ValueError: a number is NaN or infinite.
    """
    return json.dumps(value, indent=1, allow_nan=False, default=_plain) + "\n"


def checksum(content: Mapping[str, object]) -> str:
    """Return the SHA-256 hash of the JSON text of plain values, with sorted keys and no spaces."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Path):
        return value.as_posix()
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")


def read_json(path: Path, what: str) -> Any:
    """Return the content of a JSON file.

    Raises:
        DataError: the file is missing or not JSON; the message names `what` was expected.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; expected {what}") from error
    except ValueError as error:
        raise DataError(f"{path}: not valid JSON ({error}); expected {what}") from error


def write_arrays(path: Path, arrays: dict[str, np.ndarray], compress: bool = True) -> None:
    """Write named arrays to an .npz file without pickle."""
    buffer = io.BytesIO()
    save = np.savez_compressed if compress else np.savez
    save(buffer, allow_pickle=False, **arrays)
    write_bytes(path, buffer.getvalue())


def hash_of(runs: Iterable[tuple[str, str]]) -> str:
    """Return the hash of a set of runs, from pairs of name and file hash in any order."""
    lines = "".join(f"{name} {sha}\n" for name, sha in sorted(runs))
    return hashlib.sha256(lines.encode()).hexdigest()
