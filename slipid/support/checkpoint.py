"""Checkpoints: finished parts of a long job in files, from which an interrupted job continues."""

import hashlib
import json
import logging
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from slipid.support.errors import DataError
from slipid.support.files import (
    checksum,
    json_text,
    read_arrays,
    read_json,
    write_arrays,
    write_json,
)
from slipid.support.parsing import MOST_ARRAY_BYTES

SCHEMA = "slipid.checkpoint/2"
MOST_PART_BYTES = MOST_ARRAY_BYTES - 2**20
"""Largest size of the arrays of a part [bytes]; it leaves room for their headers in the file."""
_LOG = logging.getLogger("slipid")
LIBRARIES = (
    "slipid",
    "jax",
    "jaxlib",
    "equinox",
    "optimistix",
    "numpy",
    "scipy",
    "emcee",
    "scikit-learn",
)


def versions() -> dict[str, str]:
    """Return the versions of Python and of `LIBRARIES`, on which results depend, keyed by name."""
    found = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed as a package"
    return found


def source_hash(*rooms: str) -> bytes:
    """Return the hash of the source files of some packages and modules of slipid.

    `rooms` are paths of packages or modules below `slipid`, such as `data/reading`.
    """
    root = Path(__file__).resolve().parents[1]
    files = [path for room in rooms for path in (root / room).rglob("*.py")]
    found = sorted(files + [root / f"{room}.py" for room in rooms if not (root / room).is_dir()])
    return hashlib.sha256(b"".join(path.read_bytes() for path in found)).digest()


def key_of(*parts: object) -> str:
    """Return the hash of everything that the result of a job depends on, and of the versions.

    Args:
        parts: arrays, bytes, and values whose `repr` is complete: numbers, strings, plain
            containers and dataclasses of these. The `repr` of an array inside a container is
            abbreviated, so every array must be a separate part.
    """
    mark = hashlib.sha256()
    for part in (*parts, sorted(versions().items())):
        if isinstance(part, np.ndarray):
            data = f"{part.dtype.str} {part.shape} ".encode() + part.tobytes()
        else:
            data = part if isinstance(part, bytes) else repr(part).encode()
        # The length of each part precedes it, so that different lists of parts give different
        # bytes.
        mark.update(len(data).to_bytes(8, "little") + data)
    return mark.hexdigest()


def _mark(arrays: Mapping[str, np.ndarray]) -> str:
    """Return the hash of arrays with their names, types and shapes."""
    return key_of(*(part for name in sorted(arrays) for part in (name, arrays[name])))


@dataclass(frozen=True)
class Checkpoint:
    """Finished parts of one job, keyed by name, in files of one folder.

    A part is written completely or not at all. Damaged parts, which are logged, and parts of other
    jobs are treated as absent, so that they are computed again.

    Attributes:
        folder: folder of the files; it is made with the first part.
        key: hash of everything that the parts depend on (see `key_of`); files with another key are
            parts of other jobs.
    """

    folder: Path
    key: str

    def save(self, name: str, arrays: Mapping[str, np.ndarray | float | int | str]) -> None:
        """Write arrays under a name to `<name>.npz`.

        Larger arrays than can be loaded are logged instead.
        """
        content = {k: np.asarray(v) for k, v in arrays.items()}
        size = sum(array.nbytes for array in content.values())
        if size > MOST_PART_BYTES:
            _LOG.warning(
                "%s: %d bytes, too much for a checkpoint (at most %d); if the job is interrupted, "
                "this part is computed again",
                *(self.folder / f"{name}.npz", size, MOST_PART_BYTES),
            )
            return
        marks = {"key": np.asarray(self.key), "sha256": np.asarray(_mark(content))}
        write_arrays(self.folder / f"{name}.npz", content | marks, compress=False)

    def load(self, name: str) -> dict[str, np.ndarray] | None:
        """Return the arrays saved under a name, or None if this job has saved none."""
        path = self.folder / f"{name}.npz"
        if not path.exists():
            return None
        try:
            kept = read_arrays(path, "a checkpoint")
            key, written = (str(kept.pop(mark, None)) for mark in ("key", "sha256"))
            if key != self.key:
                return None
            if written == _mark(kept):
                return kept
            error = DataError(f"{path}: its content does not match its checksum")
        except DataError as found:
            error = found
        _LOG.warning("%s; it is computed again", error)
        return None

    def save_json(self, name: str, content: object) -> None:
        """Write plain values under a name to `<name>.json`."""
        path = self.folder / f"{name}.json"
        content = json.loads(json_text(content))
        mark = checksum({"content": content})
        write_json(path, {"schema": SCHEMA, "key": self.key, "sha256": mark, "content": content})

    def load_json(self, name: str) -> Any:
        """Return the plain values saved under a name, or None if this job has saved none."""
        path = self.folder / f"{name}.json"
        if not path.exists():
            return None
        try:
            kept = read_json(path, "a checkpoint")
            if kept["schema"] != SCHEMA or kept["key"] != self.key:
                return None
            if kept["sha256"] == checksum({"content": kept["content"]}):
                return kept["content"]
            error: Exception = DataError(f"{path}: its content does not match its checksum")
        except (DataError, KeyError, TypeError) as found:
            error = found
        _LOG.warning("%s; it is computed again", error)
        return None

    def remove(self, pattern: str = "*") -> None:
        """Delete the files that match a glob, including files of other jobs.

        The folder is deleted, too, if it is then empty.
        """
        for path in self.folder.glob(pattern):
            path.unlink()
        if self.folder.is_dir() and not any(self.folder.iterdir()):
            self.folder.rmdir()
