"""What computed a result: versions of the libraries, and a hash of slipid's own sources."""

import hashlib
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

LIBRARIES = ("slipid", "jax", "jaxlib", "equinox", "optimistix", "numpy", "scipy", "emcee")


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
    """Hash of the sources of some of slipid's packages, by name."""
    root = Path(__file__).resolve().parents[1]
    found = sorted(path for room in rooms for path in (root / room).rglob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in found)).digest()
