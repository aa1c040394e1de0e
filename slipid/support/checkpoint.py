"""Checkpoints: finished parts of a long job on disk, from which the same job continues."""

import hashlib
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from slipid.support.errors import DataError
from slipid.support.files import read_json, write_arrays, write_json

SCHEMA = "slipid.checkpoint/1"
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
    """Return the version of Python and of every library that numbers depend on, by name."""
    found = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed as a package"
    return found


def source_hash(*rooms: str) -> bytes:
    """Return the hash of the sources of some packages and modules of slipid, with their paths."""
    root = Path(__file__).resolve().parents[1]
    files = [path for room in rooms for path in (root / room).rglob("*.py")]
    found = sorted(files + [root / f"{room}.py" for room in rooms if not (root / room).is_dir()])
    return hashlib.sha256(b"".join(path.read_bytes() for path in found)).digest()


def key_of(*parts: object) -> str:
    """Return the hash of everything a job depends on, library versions included.

    Args:
        parts: arrays, bytes, and values whose `repr` is complete: numbers, strings, plain
            containers and dataclasses of those. The `repr` of an array inside a container is not
            complete, so every array has to be a part of its own.
    """
    mark = hashlib.sha256()
    for part in (*parts, sorted(versions().items())):
        if isinstance(part, np.ndarray):
            data = f"{part.dtype.str} {part.shape} ".encode() + part.tobytes()
        else:
            data = part if isinstance(part, bytes) else repr(part).encode()
        # the length goes first, so that no two lists of parts give the same bytes
        mark.update(len(data).to_bytes(8, "little") + data)
    return mark.hexdigest()


@dataclass(frozen=True)
class Checkpoint:
    """Named parts in files of one folder; those of other jobs are treated as absent.

    A part is written whole or not at all, and a damaged one counts as absent: whatever is loaded is
    valid, and whatever is not is computed again.

    Attributes:
        folder: folder of the files; it is made with the first part.
        key: hash of everything the parts depend on, see `key_of`.
    """

    folder: Path
    key: str

    def save(self, name: str, arrays: Mapping[str, np.ndarray | float | int | str]) -> None:
        """Write arrays under a name to `<name>.npz`."""
        content = {k: np.asarray(v) for k, v in arrays.items()}
        path = self.folder / f"{name}.npz"
        write_arrays(path, content | {"key": np.asarray(self.key)}, compress=False)

    def load(self, name: str) -> dict[str, np.ndarray] | None:
        """Return the arrays under a name; None where this very job has left none."""
        try:
            # opened here because numpy leaves damaged files open
            path = self.folder / f"{name}.npz"
            with path.open("rb") as file, np.load(file, allow_pickle=False) as kept:
                if str(kept["key"]) != self.key:
                    return None
                return {k: kept[k] for k in kept.files if k != "key"}
        except (OSError, EOFError, KeyError, ValueError, BadZipFile):
            return None

    def save_json(self, name: str, content: object) -> None:
        """Write plain values under a name to `<name>.json`."""
        path = self.folder / f"{name}.json"
        write_json(path, {"schema": SCHEMA, "key": self.key, "content": content})

    def load_json(self, name: str) -> Any:
        """Return the plain values under a name; None where this very job has left none."""
        try:
            kept = read_json(self.folder / f"{name}.json", "a checkpoint")
            if kept["schema"] == SCHEMA and kept["key"] == self.key:
                return kept["content"]
        except (DataError, KeyError, TypeError):
            pass
        return None

    def remove(self, pattern: str = "*") -> None:
        """Delete files by name, of whatever job, and the folder if it is then empty."""
        for path in self.folder.glob(pattern):
            path.unlink()
        if self.folder.is_dir() and not any(self.folder.iterdir()):
            self.folder.rmdir()
