"""Setup of JAX: float64, XLA without fusion emitters, and a persistent compilation cache."""

import os
import sys
import warnings
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

PLAIN_LOOPS = "--xla_cpu_use_fusion_emitters=false"
MEASURED_JAXLIB = "0.10."
"""Versions of jaxlib with which flags and options of XLA were measured."""


def plain_loops() -> None:
    """Make XLA compile loops without its fusion emitters, unless XLA_FLAGS already mentions them.

    The compilation of a fit then takes three quarters of the time, and the fit itself is no slower;
    rollouts of the twin take 0.3 to 0.6 of the time. The function must be called before the first
    computation of JAX. XLA ends the process at unknown flags, so the flag is set only for versions
    of jaxlib with which this was measured. If XLA_FLAGS names a file of flags, XLA_FLAGS stays
    unchanged.
    """
    flags = os.environ.get("XLA_FLAGS", "").strip()
    more = "fusion_emitters" not in flags and (not flags or flags.startswith("-"))
    if more and version("jaxlib").startswith(MEASURED_JAXLIB):
        os.environ["XLA_FLAGS"] = f"{flags} {PLAIN_LOOPS}".strip()


def unfused() -> dict[str, str | bool] | None:
    """Return options of `jax.jit` for a long program without loops, None for other jaxlibs.

    XLA's fusion copies operations into all operations that use them: in the derivatives of a motor,
    there are eight times as many afterwards, and compilation takes four times as long and a call
    twice as long as without fusion (measured on CPUs).
    """
    if not version("jaxlib").startswith(MEASURED_JAXLIB):
        return None
    return {"xla_disable_hlo_passes": "fusion", "xla_cpu_use_fusion_emitters": True}


def one_blas_thread() -> None:
    """Make BLAS and LAPACK compute in one thread.

    The matrices of slipid are small. Several BLAS threads would wait for each other in busy loops:
    on two cores with another job, the Cholesky factor of a 570 x 570 matrix takes 800 ms with them,
    and 3 ms in one thread.
    """
    import scipy.linalg  # noqa: F401  # loads the BLAS that JAX calls, so that the limit applies
    from threadpoolctl import threadpool_limits

    threadpool_limits(1, user_api="blas")


def cache_folder() -> Path:
    """Return the folder of slipid's cache: SLIPID_CACHE, else one in the platform's cache."""
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
    """Set JAX up, and print the setup on stderr unless quiet.

    Every command that computes calls this first. A compilation cache that is named by JAX's own
    environment variable is kept. If the cache is not writable, compilation only takes longer.
    """
    plain_loops()
    import jax

    one_blas_thread()

    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")
    jax.config.update("jax_enable_x64", True)
    # processes of jobs inherit this, or the arrays of their first job would be rounded to float32
    os.environ["JAX_ENABLE_X64"] = "1"
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ or "SLIPID_CACHE" in os.environ:
        folder = cache_folder() / "jax"
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            jax.config.update("jax_compilation_cache_dir", str(folder))
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    if not quiet:
        flags = os.environ.get("XLA_FLAGS", "none")
        print(f"slipid: JAX computes in float64; XLA flags: {flags}", file=sys.stderr)
