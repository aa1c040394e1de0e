"""Settings of the machine room: float64, plain loops, a compilation cache that outlives it all."""

import os
import sys
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

PLAIN_LOOPS = "--xla_cpu_use_fusion_emitters=false"


def plain_loops() -> None:
    """Have XLA write loops without its fusion emitters, unless XLA_FLAGS says something of them.

    A fit is compiled in three quarters of the time and runs as fast; rollouts of the twin take 0.3
    to 0.6 of the time. Must come before JAX first computes. XLA ends the process at flags that it
    does not know, so other versions than those it was measured with are left alone, and so is a
    file of flags.
    """
    flags = os.environ.get("XLA_FLAGS", "").strip()
    more = "fusion_emitters" not in flags and (not flags or flags.startswith("-"))
    if more and version("jaxlib").startswith("0.10."):
        os.environ["XLA_FLAGS"] = f"{flags} {PLAIN_LOOPS}".strip()


def one_blas_thread() -> None:
    """Have BLAS and LAPACK compute in one thread.

    The matrices here are small, and threads that wait for each other by spinning make a Cholesky
    factor of 570 rows take 800 ms instead of 3 on two cores on which another job runs.
    """
    import scipy.linalg  # noqa: F401  # loads what JAX computes with
    from threadpoolctl import threadpool_limits

    threadpool_limits(1, user_api="blas")


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


def setup_jax(quiet: bool = False) -> None:
    """Switch on all of them and say so on stderr; every command that computes calls this first.

    A cache named by JAX's own variable stays; one that cannot be written costs time, nothing else.
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
