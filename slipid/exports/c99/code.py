"""Header and source of a control loop in C99, generated from the JAX functions of the library."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import equinox as eqx
import jax.numpy as jnp

from slipid.exports.c99.builder import Names
from slipid.exports.c99.function import Argument, Function, function
from slipid.exports.c99.text import TYPES, WIDTH, folded, table
from slipid.exports.description import header
from slipid.exports.fields import Struct, fields_of
from slipid.exports.text import filled, identifiers, listed, template, wrapped
from slipid.robot.closed_loop import ControlLoop
from slipid.robot.deployed import DeployedRobot
from slipid.robot.filter.hypotheses import hypotheses_of
from slipid.robot.interface import Measurement, Readings
from slipid.robot.trajectory import Path

TYPE = {**TYPES, "real": "slipid_real"}


class Code:
    """The C code of a control loop, and of a path if it follows one.

    Attributes:
        robot: robot with the record of its numbers.
        loop: estimator and controller.
        path: path for a robot that starts at the origin; None without one.
        estimator: struct of the estimator's state.
        controller: struct of the controller's state.
        reading: struct of the inputs.
        estimate: struct of the outputs.
        structs: all structs.
        functions: all generated functions.
    """

    def __init__(
        self, robot: DeployedRobot, loop: ControlLoop[eqx.Module], path: Path | None = None
    ):
        """Trace and lower all functions.

        Raises:
            UnsupportedError: a step uses a primitive without a form in C.
        """
        self.robot, self.loop, self.path = robot, loop, path
        self._names = Names()
        begin, nothing, zero = loop.init(), Readings.nothing(robot.wheels), jnp.zeros(())
        estimate = loop.estimator.step(begin.estimator, nothing, zero)[1]
        self.estimator = _struct("estimator", "State of the estimator.", begin.estimator)
        self.controller = _struct("controller", "State of the controller.", begin.controller)
        about = "Readings of the sensors; NaN if there is no reading."
        self.reading = _struct("reading", about, nothing, Measurement)
        self.estimate = _struct("estimate", "Output of the estimator.", estimate)
        self.structs = self.estimator, self.controller, self.reading, self.estimate
        self.functions = list(self._functions())

    def _functions(self) -> Iterator[Function]:
        loop, wheels = self.loop, self.robot.wheels
        pose, dt = Argument.plain("pose", (3,)), Argument.plain("dt", ())
        yield function(
            self._names,
            "slipid_begin",
            "Initialise estimator and controller of a robot at rest at a pose: x, y [m], heading "
            "[rad].",
            (
                Argument.of("estimator", self.estimator, read=False, written=True),
                Argument.of("controller", self.controller, read=False, written=True),
                pose,
            ),
            lambda pose: (loop.init(pose).estimator, loop.init(pose).controller),
        )
        yield function(
            self._names,
            "slipid_nothing",
            "Set all fields of a reading to NaN (no reading); then fill in the measured ones.",
            (Argument.of("reading", self.reading, read=False, written=True),),
            lambda: Readings.nothing(wheels),
        )
        yield function(
            self._names,
            "slipid_observe",
            "Step of the estimator: process the readings of the sensors dt [s] after the last "
            "call.",
            (
                Argument.of("estimator", self.estimator, written=True),
                Argument.of("reading", self.reading),
                dt,
                Argument.of("estimate", self.estimate, read=False, written=True),
            ),
            loop.estimator.step,
        )
        yield function(
            self._names,
            "slipid_command",
            "Step of the controller: compute the wheel speeds to command [rad/s] for a "
            "reference, x, y [m], heading [rad] and their rates in the world [m/s, m/s, rad/s].",
            (
                Argument.of("controller", self.controller, written=True),
                Argument.plain("reference", (6,)),
                Argument.of("estimate", self.estimate),
                dt,
                Argument.plain("command", (wheels,), read=False, written=True),
            ),
            loop.controller.step,
        )
        if self.path is not None:
            yield self._follow(self.path)

    def _follow(self, path: Path) -> Function:
        preview = self.loop.controller.gains.preview
        begin = ", ".join(f"{float(x):g}" for x in path.rows[0, :3])

        def follow(time: jnp.ndarray, pose: jnp.ndarray, dt: jnp.ndarray) -> object:
            here = jnp.where(jnp.isfinite(pose), pose, 1e3)
            return path.follow(time, here, dt, preview)

        return function(
            self._names,
            "slipid_follow",
            "Advance the time of the path [s], which begins at 0, for a robot at a pose, and "
            f"return the reference at that time. The path begins at {begin} [m, m, rad] and lasts "
            f"{path.duration:g} s; it waits for a robot that lags.",
            (
                Argument.plain("time", (), written=True),
                Argument.plain("pose", (3,)),
                Argument.plain("dt", ()),
                Argument.plain("reference", (6,), read=False, written=True),
            ),
            follow,
        )

    @property
    def kept(self) -> int:
        """Count of the numbers in the state of estimator, controller and path."""
        return sum(f.size for s in (self.estimator, self.controller) for f in s.fields) + 1

    @property
    def scratch(self) -> int:
        """Largest count of numbers that a function keeps in arrays on the stack."""
        return max(f.scratch for f in self.functions)

    def header(self) -> str:
        """Return the text of slipid.h."""
        robot = self.robot
        names = identifiers(robot.labels, "floor")
        defines = [
            f"SLIPID_WHEELS {robot.wheels}",
            f"SLIPID_FLOORS {len(robot.labels)}",
            *(f"SLIPID_FLOOR_{name.upper()} {k}" for k, name in enumerate(names)),
            *([] if self.path is None else [f"SLIPID_PATH_SECONDS {self.path.duration!r}"]),
        ]
        public = ["slipid_init", "slipid_step", *(f.name for f in self.functions)]
        values = {
            "HEAD": _comment(*header(robot)),
            "ROBOT": robot.record.numbers,
            "DEFINES": [f"#define {d}" for d in defines],
            "ABOUT": [line for part in about(self.loop) for line in _comment(part)],
            "SINGLE": [f"#define {name} {name}_float" for name in public],
            "STRUCTS": [line for s in self.structs for line in _definition(s)],
            "FUNCTIONS": [
                line
                for f in self.functions
                for line in (*_comment(f.about), *folded(f"{f.head};", ""), "")
            ],
        }
        return filled("c99/slipid.h", values)

    def source(self) -> str:
        """Return the text of slipid.c."""
        reads = frozenset[str]().union(*(f.reads for f in self.functions))
        tables = [m for m in self._names.tables.values() if m.name in reads]
        values = {
            "HEAD": _comment(*header(self.robot)),
            "PRELUDE": template("c99/prelude.c"),
            "TABLES": [line for m in tables for line in table(m)],
            "FUNCTIONS": [line for f in self.functions for line in f.text],
        }
        return filled("c99/slipid.c", values)


def _struct(name: str, about: str, tree: object, documented: type | None = None) -> Struct:
    """Return the struct of a tree; `documented` is as in `fields_of`."""
    return Struct(f"slipid_{name}", about, fields_of(tree, documented), tree)


def about(loop: ControlLoop[eqx.Module]) -> Iterator[str]:
    """Yield sentences about axes, wheels, sensors and floors, for readers of the header."""
    robot = loop.controller.robot
    yield (
        "Axes of the body: x ahead, y left, angles counter-clockwise. Axes of the world: those "
        "of the start pose. A twist is in the body's axes."
    )
    rows = zip(robot.places.tolist(), robot.forward.tolist(), strict=True)
    for k, ((x, y), row) in enumerate(rows):
        drives = math.degrees(math.atan2(row[1], row[0]))
        yield (
            f"Wheel {k} is at x = {x:.4f} m, y = {y:.4f} m; with a positive speed it pushes the "
            f"body in the direction {drives:.1f} deg."
        )
    settings = loop.estimator.settings
    signs = (
        "with their signs" if settings.current_is_signed else "as magnitudes (signs are ignored)"
    )
    stale = float(settings.stale_s)
    yield f"Currents are used {signs}. A wheel without readings for {stale:g} s is stale."
    yield "Floors, in the order of the columns: " + listed([*robot.labels, "none of them"]) + "."
    rows = hypotheses_of(robot).under.tolist()
    each = "; ".join(f"{k}: {' '.join(map(str, row))}" for k, row in enumerate(rows))
    yield f"Hypotheses, in the order of the rows, with the floor under each wheel: {each}."


def _comment(*parts: str) -> list[str]:
    """Return the lines of a C comment."""
    lines = [line.replace("*/", "* /") for part in parts for line in wrapped(part)]
    return (
        [f"/* {lines[0]}", *(f"   {line}" for line in lines[1:-1]), f"   {lines[-1]} */"]
        if len(lines) > 1
        else [f"/* {lines[0]} */"]
    )


def _definition(struct: Struct) -> Sequence[str]:
    """Return the lines of C that define a struct."""
    lines = [*_comment(struct.about), "typedef struct {"]
    for field in struct.fields:
        size = f"[{field.size}]" if field.shape else ""
        shape = "" if len(field.shape) < 2 else f", {' x '.join(map(str, field.shape))} by rows"
        declared, comment = f"  {TYPE[field.numbers]} {field.name}{size};", f"{field.about}{shape}"
        if len(declared) + len(comment) + 7 <= WIDTH:
            lines.append(f"{declared} /* {comment} */")
        else:
            lines += [*(f"  {line}" for line in _comment(comment)), declared]
    return [*lines, f"}} {struct.name};", ""]
