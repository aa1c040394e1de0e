"""JAX setup: float64, plain loops and a persistent compilation cache."""

import os
import sys
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

PLAIN_LOOPS = "--xla_cpu_use_fusion_emitters=false"


def plain_loops() -> None:
    """Make XLA write loops without its fusion emitters, unless XLA_FLAGS mentions them.

    A fit is compiled in three quarters of the time and runs as fast; rollouts of the twin take 0.3
    to 0.6 of the time. It must be called before JAX first computes. XLA ends the process at unknown
    flags, so only the versions that were measured are changed, and a file of flags is left alone.
    """
    flags = os.environ.get("XLA_FLAGS", "").strip()
    more = "fusion_emitters" not in flags and (not flags or flags.startswith("-"))
    if more and version("jaxlib").startswith("0.10."):
        os.environ["XLA_FLAGS"] = f"{flags} {PLAIN_LOOPS}".strip()


def one_blas_thread() -> None:
    """Make BLAS and LAPACK compute in one thread.

    The matrices here are small, and threads that wait for each other by spinning make a Cholesky
    factor of 570 rows take 800 ms instead of 3 on two cores on which another job runs.
    """
    import scipy.linalg  # noqa: F401  # loads what JAX computes with
    from threadpoolctl import threadpool_limits

    threadpool_limits(1, user_api="blas")


def cache_folder() -> Path:
    """Return the folder of compiled functions: SLIPID_CACHE, else the platform's for caches."""
    if given := os.environ.get("SLIPID_CACHE"):
        return Path(given)
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA")
        return (Path(base) if base else Path.home() / "AppData" / "Local") / "slipid" / "cache"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "slipid"
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "slipid"


def setup_jax(quiet: bool = False) -> None:
    """Apply the whole setup and print it on stderr; every command that computes calls this first.

    A cache named by JAX's own variable is kept; an unwritable one only costs time.
    """
    plain_loops()
    import jax

    one_blas_thread()

    jax.config.update("jax_enable_x64", True)
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ or "SLIPID_CACHE" in os.environ:
        folder = cache_folder() / "jax"
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            jax.config.update("jax_compilation_cache_dir", str(folder))
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    if not quiet:
        flags = os.environ.get("XLA_FLAGS", "none")
        print(f"slipid: JAX computes in float64; XLA flags: {flags}", file=sys.stderr)
