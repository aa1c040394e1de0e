"""Generated C code as functions on numpy arrays, compiled by whatever compiler is there."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import jax
import numpy as np
import pytest

from slipid.deploy.controllers import control_loop_of
from slipid.exports.c99.code import Code
from slipid.exports.fields import Struct
from slipid.lab.trial.controllers import ROWS
from slipid.robot.trajectory import rectangle
from tests.helpers import small_twin

MANY = """
void slipid_many(int32_t count, slipid_estimator *estimator, slipid_controller *controller,
                 const slipid_reading *reading, const slipid_real *reference, const slipid_real *dt,
                 slipid_estimate *estimate, slipid_real *command);

void slipid_many(int32_t count, slipid_estimator *estimator, slipid_controller *controller,
                 const slipid_reading *reading, const slipid_real *reference, const slipid_real *dt,
                 slipid_estimate *estimate, slipid_real *command) {
  for (int32_t k = 0; k < count; ++k) {
    slipid_observe(&estimator[k], &reading[k], dt[k], &estimate[k]);
    slipid_command(&controller[k], &reference[6 * k], &estimate[k], dt[k],
                   &command[SLIPID_DRIVES * k]);
  }
}
"""
"""One step of many robots."""
QUICK = ("-O2", "-fno-math-errno", "-fno-trapping-math")
NEEDS_COMPILER = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")


@cache
def code(row: str) -> Code:
    """Of a row of the trial for a small robot, with a rectangle to follow."""
    robot = small_twin.deployed(1.0, 1.0, 0.3)
    return Code(robot, control_loop_of(robot, ROWS[row]), rectangle())


@dataclass(frozen=True)
class Kinds:
    """How C stores the numbers of a build."""

    real: type

    def of(self, struct: Struct) -> np.dtype:
        """A struct as numpy's."""
        kinds = {"real": self.real, "int": np.int32, "bool": np.bool_}
        return np.dtype([(f.name, kinds[f.numbers], f.shape) for f in struct.fields], align=True)


_LIBRARIES: dict[tuple[str, ...], ctypes.CDLL] = {}
"""What was compiled, by its text, compiler and flags; it stays loaded without its folder."""


def _built(of: tuple[str, ...], folder: Path) -> ctypes.CDLL:
    """The library of a header, a source, a compiler and its flags, compiled once in a process."""
    if of not in _LIBRARIES:
        header, source, compiler, *flags = of
        (folder / "slipid.h").write_text(header)
        (folder / "slipid.c").write_text(source)
        library = folder / f"slipid{len(list(folder.iterdir()))}.so"
        shared = ["-shared", "-fPIC", "-o", str(library), "slipid.c", "-lm"]
        subprocess.run([compiler, "-std=c99", *flags, *shared], cwd=folder, check=True)
        _LIBRARIES[of] = ctypes.CDLL(str(library))
    return _LIBRARIES[of]


class CompiledC:
    """A control loop's code, compiled: its structs as numpy records, its functions on them.

    Attributes:
        code: that was compiled; kinds: of its numbers; library: it, with `more` C functions.
        estimator, controller, reading, estimate: records that the functions work on.
    """

    def __init__(
        self,
        code: Code,
        folder: Path,
        flags: Sequence[str] = QUICK,
        compiler: str = "cc",
        more: str = "",
    ):
        self.code = code
        single = "-DSLIPID_FLOAT" in flags
        self.kinds = Kinds(np.float32 if single else np.float64)
        self._number = ctypes.c_float if single else ctypes.c_double
        text = code.header(), code.source() + MANY + more
        self.library = _built((*text, compiler, *flags), folder)
        self.estimator = np.zeros((), self.kinds.of(code.estimator))
        self.controller = np.zeros((), self.kinds.of(code.controller))
        self.reading = np.zeros((), self.kinds.of(code.reading))
        self.estimate = np.zeros((), self.kinds.of(code.estimate))
        self.command = np.zeros(code.loop.controller.robot.drives, self.kinds.real)
        self.time = np.zeros((), self.kinds.real)
        self.reference = np.zeros(6, self.kinds.real)

    def begin(self, pose: Sequence[float]) -> None:
        """Start at a pose."""
        self._call("begin", self.estimator, self.controller, np.asarray(pose, self.kinds.real))

    def observe(self, dt: float) -> None:
        """The estimator's step."""
        self._call("observe", self.estimator, self.reading, dt, self.estimate)

    def control(self, dt: float) -> None:
        """The controller's step."""
        parts = (self.controller, self.reference, self.estimate, dt, self.command)
        self._call("command", *parts)

    def follow(self, dt: float) -> None:
        """The path's step."""
        pose = np.ascontiguousarray(self.estimate["pose"])
        self._call("follow", self.time, pose, dt, self.reference)

    def many(
        self,
        estimator: np.ndarray,
        controller: np.ndarray,
        reading: np.ndarray,
        reference: np.ndarray,
        dt: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """One step of as many robots as there are records; states are changed in place.

        Returns:
            Estimates, and commands (robot, wheel).
        """
        count = len(dt)
        said = np.zeros(count, self.estimate.dtype)
        command = np.zeros((count, len(self.command)), self.kinds.real)
        with np.errstate(over="ignore"):
            given = [np.ascontiguousarray(x, self.kinds.real) for x in (reference, dt)]
        arrays = (estimator, controller, reading, *given, said, command)
        pointers = [a.ctypes.data_as(ctypes.c_void_p) for a in arrays]
        self.library.slipid_many(ctypes.c_int32(count), *pointers)
        return said, command

    def _call(self, name: str, *arguments: np.ndarray | float) -> None:
        given = [
            a.ctypes.data_as(ctypes.c_void_p) if isinstance(a, np.ndarray) else self._number(a)
            for a in arguments
        ]
        suffix = "_float" if self._number is ctypes.c_float else ""
        getattr(self.library, f"slipid_{name}{suffix}")(*given)


def put(record: np.ndarray, tree: object) -> None:
    """Fill a record with the leaves of a tree."""
    names = record.dtype.names
    assert names is not None
    for name, leaf in zip(names, jax.tree.leaves(tree), strict=True):
        record[name] = np.asarray(leaf)


def worst(record: np.ndarray, tree: object, least: float = 1e-3) -> dict[str, float]:
    """Largest difference of each field of a record from a leaf, over the leaf's largest number."""
    names = record.dtype.names
    assert names is not None
    out = {}
    for name, leaf in zip(names, jax.tree.leaves(tree), strict=True):
        a, b = np.asarray(record[name], float), np.asarray(leaf, float)
        scale = max(np.nanmax(np.abs(b), initial=0.0), least)
        same = (np.isnan(a) & np.isnan(b)) | (a == b)
        gap = np.where(same, 0.0, np.abs(a - b))
        out[name] = float(np.max(np.where(np.isnan(gap), np.inf, gap), initial=0.0) / scale)
    return out
