"""Settings every test runs under: float64, shape checks, one compilation cache, no display."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from ctypes import CDLL
from ctypes.util import find_library
from importlib.metadata import version
from pathlib import Path

import pandas as pd
import pytest
from xdist.scheduler import LoadFileScheduling

from slipid.support.jax_setup import one_blas_thread, plain_loops

ROOT = Path(__file__).resolve().parents[1]
GOLDENS = Path(__file__).with_name("goldens")
LONG = (
    *("test_cli", "test_real_fit", "test_crossing", "test_demo", "test_recovery", "test_folds"),
    *("test_every_drive", "test_optimise", "test_notebooks", "test_consistency", "test_c_steps"),
    *("test_left_out", "test_real_logs", "test_plant", "test_c_folder", "test_estimator"),
    *("test_likelihood", "test_ensemble", "test_simulate", "test_public", "test_calibration"),
    *("test_result", "test_trial"),
)
"""Files that take longest, the longest first."""
TOGETHER = {"test_cli": "small", "test_crossing": "small", "test_folds": "small"}
"""Files whose fits have the same structure run in one process: it compiles them once."""
MANY = 1_000_000
"""Objects that were made since garbage was collected, from which on it is again."""
MOST_MB = 1300.0
"""Memory after a file from which on a worker forgets what was compiled."""

# Set in the environment, so that commands and notebooks started by a test share them. The cache is
# what keeps the second run of the suite short: most of the first is compilation.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
plain_loops()
# Workers use all cores already: code that is generated in several parts costs more CPU time.
if version("jaxlib").startswith(("0.10.", "0.11.", "0.12.")):
    whole = "--xla_cpu_parallel_codegen_split_count=1"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {whole}".strip()
os.environ["MPLBACKEND"] = "Agg"
# MuJoCo chooses at its first import what it draws with; without EGL it must not be told to use it.
if find_library("EGL"):
    os.environ.setdefault("MUJOCO_GL", "egl")

# Commands that tests start compile slipid anew, seconds each, where its bytecode is not kept.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

import jax

from tests.helpers.checked import check_types_of

jax.config.update("jax_enable_x64", True)
one_blas_thread()

# Shapes and types of every annotated function of slipid are checked while tests run; under jit this
# costs at tracing only, elsewhere more than half of the time: `make test` leaves it to `make check`
# and `make nightly`. Must come before the first import of what computes.
if os.environ.get("SLIPID_CHECK_TYPES", "1") != "0":
    check_types_of("slipid")


@pytest.fixture(autouse=True, scope="session")
def laplace_intervals() -> Iterator[None]:
    """Let fits in this process keep their Laplace intervals, since a chain takes ten seconds.

    Fits in processes of their own, such as the demo's, and `test_short_chain` have the chain.
    """
    from slipid.app import identify

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(identify, "short_chain", lambda *_: None)
        yield


@pytest.fixture
def original_datadir() -> Path:
    """Folder of the reviewed numbers that `golden` compares with."""
    return GOLDENS


@pytest.fixture
def golden(dataframe_regression):
    """Compare rows of numbers with a reviewed table, `tests/goldens/NAME.csv`.

    Numbers must agree to a relative `rtol` or an absolute `atol`, words to the letter. After a
    change that is meant to move numbers, `pytest --force-regen` writes the tables anew: commit
    them apart and say why they moved.
    """

    def check(name: str, rows: list[dict], rtol: float = 1e-6, atol: float = 1e-12) -> None:
        table = pd.DataFrame(rows)
        dataframe_regression.check(
            table, basename=name, default_tolerance={"rtol": rtol, "atol": atol}
        )

    return check


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of the real logs: SLIPID_DATA, else ../shared/data beside the repository."""
    folder = Path(os.environ.get("SLIPID_DATA") or ROOT.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"no real logs: {folder} is no folder (set SLIPID_DATA)")
    return folder


@pytest.fixture(scope="session")
def small(tmp_path_factory):
    """A folder with a config, made logs, unseen logs, and what identify said; to be read alone."""
    from tests.helpers.shared import identify, once

    return once(tmp_path_factory, "small", identify)


@pytest.fixture(scope="session")
def sampled(small, tmp_path_factory):
    """A copy of that fit, and the end of a `sample` of far too few steps; to be read alone."""
    from tests.helpers.shared import once, sample

    folder, said = once(tmp_path_factory, "sampled", lambda f: sample(small[0] / "out", f / "out"))
    return folder / "out", said


def pytest_configure(config):
    """Tests compile more than they compute, and plainer code is compiled sooner; not what is timed.

    Commands and notebooks that tests start read it from the environment.
    """
    if not any("bench" in word for word in (*config.getini("python_files"), *config.args)):
        plain = os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
        jax.config.update("jax_disable_most_optimizations", plain.lower() in ("1", "true", "yes"))


def pytest_collection_modifyitems(items):
    """Files that take longest come first, so that two workers end together."""
    place = {name: k for k, name in enumerate(LONG)}
    items.sort(key=lambda item: place.get(item.path.stem, len(LONG)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """A file runs in one process, and so do the files of a group."""

    class GroupScheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = super()._split_scope(nodeid)
            group = "api" if file.startswith("tests/api/") else TOGETHER.get(Path(file).stem)
            return group or file

    return GroupScheduling(config, log)


@pytest.fixture(scope="module", autouse=True)
def _room_for_compiled_code(request):
    """After a file garbage is collected, and what its functions keep is let go.

    Tracing makes many objects that live long, and looking through them all again and again took a
    sixth of the suite: garbage is collected between files alone, and only after files that made
    many objects, for a look takes a second; or where memory runs short.
    """
    gc.disable()
    yield
    for made in vars(request.module).values():  # problems and fits
        clear = getattr(made, "cache_clear", None)
        if clear and made.__module__ == request.module.__name__:
            clear()
    if gc.get_count()[0] > MANY:
        gc.collect()
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > 15_000:
        _forget()
    _make_room(MOST_MB)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown():
    """Within a file memory may grow more before what tests of it share is compiled again."""
    yield
    _make_room(1.5 * MOST_MB)


_taken = 0.0
"""Memory that was left when room was last made [MB]."""


def _make_room(most_mb: float) -> None:
    """Forget what was compiled where memory is more than this and grew since that was last done."""
    if _resident_mb() > max(most_mb, _taken + 0.2 * most_mb):
        _forget()


def _forget() -> None:
    """Forget what was compiled; it comes back from the cache on disk.

    Compiled functions hold memory, and memory maps as well: at vm.max_map_count (65 530 by default)
    the next compilation is a segmentation fault.
    """
    global _taken
    jax.clear_caches()
    gc.collect()
    with suppress(OSError, AttributeError):
        CDLL(None).malloc_trim(0)
    _taken = _resident_mb()


def _resident_mb() -> float:
    """Memory that this process holds [MB]; 0 where the system does not say."""
    statm = Path("/proc/self/statm")
    if not statm.exists():
        return 0.0
    return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
