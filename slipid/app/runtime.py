"""Settings of the machine room: float64 and a compilation cache that outlives the process."""

import os
import sys
from pathlib import Path


def cache_folder() -> Path:
    """Where compiled functions are kept: SLIPID_CACHE, else the platform's place for caches."""
    if given := os.environ.get("SLIPID_CACHE"):
        return Path(given)
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA")
        return (Path(base) if base else Path.home() / "AppData" / "Local") / "slipid" / "cache"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "slipid"
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "slipid"


def start() -> None:
    """Switch on float64 and the cache; every command that computes calls this first.

    A cache named by JAX's own variable stays; one that cannot be written costs time, nothing else.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    if "JAX_COMPILATION_CACHE_DIR" in os.environ and "SLIPID_CACHE" not in os.environ:
        return
    folder = cache_folder() / "jax"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
