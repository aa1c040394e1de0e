"""Finished parts of a long piece of work, kept on disk for the same work to go on from."""

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
    """Version of Python and of every library that numbers depend on, by name."""
    found = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed as a package"
    return found


def source_hash(*rooms: str) -> bytes:
    """Hash of the sources of some of slipid's packages and modules, by their paths inside it."""
    root = Path(__file__).resolve().parents[1]
    files = [path for room in rooms for path in (root / room).rglob("*.py")]
    found = sorted(files + [root / f"{room}.py" for room in rooms if not (root / room).is_dir()])
    return hashlib.sha256(b"".join(path.read_bytes() for path in found)).digest()


def key_of(*parts: object) -> str:
    """Hash of everything a piece of work depends on; the versions of libraries are always in it.

    Args:
        parts: arrays, bytes, and values whose `repr` says all of them: numbers, strings, plain
            containers and dataclasses of those. An array inside a container is not seen whole, so
            every array has to be a part of its own.
    """
    mark = hashlib.sha256()
    for part in (*parts, sorted(versions().items())):
        if isinstance(part, np.ndarray):
            data = f"{part.dtype.str} {part.shape} ".encode() + part.tobytes()
        else:
            data = part if isinstance(part, bytes) else repr(part).encode()
        # the length goes first, so that no two lists of parts read the same
        mark.update(len(data).to_bytes(8, "little") + data)
    return mark.hexdigest()


@dataclass(frozen=True)
class Checkpoint:
    """Named parts in files of one folder; those of other work are treated as absent.

    A part is written whole or not at all, and one that is damaged is absent, too: whatever is
    loaded can be relied on, and whatever is not is made again.

    Attributes:
        folder: where the files lie; it is made with the first part.
        key: hash of everything the parts depend on, see `key_of`.
    """

    folder: Path
    key: str

    def save(self, name: str, arrays: Mapping[str, np.ndarray | float | int | str]) -> None:
        """Keep arrays under a name, in `<name>.npz`."""
        content = {k: np.asarray(v) for k, v in arrays.items()}
        path = self.folder / f"{name}.npz"
        write_arrays(path, content | {"key": np.asarray(self.key)}, compress=False)

    def load(self, name: str) -> dict[str, np.ndarray] | None:
        """Arrays that were kept under a name; None where this very work has left none."""
        try:
            # opened here: numpy leaves a damaged file open
            path = self.folder / f"{name}.npz"
            with path.open("rb") as file, np.load(file, allow_pickle=False) as kept:
                if str(kept["key"]) != self.key:
                    return None
                return {k: kept[k] for k in kept.files if k != "key"}
        except (OSError, EOFError, KeyError, ValueError, BadZipFile):
            return None

    def save_json(self, name: str, content: object) -> None:
        """Keep plain values under a name, in `<name>.json`."""
        path = self.folder / f"{name}.json"
        write_json(path, {"schema": SCHEMA, "key": self.key, "content": content})

    def load_json(self, name: str) -> Any:
        """Plain values that were kept under a name; None where this very work has left none."""
        try:
            kept = read_json(self.folder / f"{name}.json", "a part of unfinished work")
            if kept["schema"] == SCHEMA and kept["key"] == self.key:
                return kept["content"]
        except (DataError, KeyError, TypeError):
            pass
        return None

    def remove(self, pattern: str = "*") -> None:
        """Take away files by name, of whatever work, and the folder if nothing is left in it."""
        for path in self.folder.glob(pattern):
            path.unlink()
        if self.folder.is_dir() and not any(self.folder.iterdir()):
            self.folder.rmdir()
