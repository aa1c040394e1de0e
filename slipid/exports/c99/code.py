"""Header and source of a control loop in C99, generated from slipid's own JAX functions."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import equinox as eqx
import jax

from slipid.exports.c99.builder import Names
from slipid.exports.c99.function import Argument, Function, function
from slipid.exports.c99.text import CODE_WIDTH, TYPES, folded, table
from slipid.exports.description import header
from slipid.exports.fields import Struct, structs_of
from slipid.exports.text import filled, identifiers, listed, template, wrapped
from slipid.robot.closed_loop import ControlLoop
from slipid.robot.deployed import DeployedRobot
from slipid.robot.filter.hypotheses import hypotheses_of
from slipid.robot.interface import Readings
from slipid.robot.trajectory import Path

C_TYPES = {**TYPES, "real": "slipid_real"}
"""C type of each kind of number in slipid.h."""


class Code:
    """The C code of a control loop, and of a path that it follows.

    Attributes:
        robot: robot with the record of its parameters.
        loop: estimator and controller.
        path: path that `slipid_follow` follows.
        estimator: struct of the estimator's state.
        controller: struct of the controller's state.
        reading: struct of the sensors' readings, the input of the estimator.
        estimate: struct of the estimator's output.
        structs: all structs.
        functions: all generated functions.
    """

    def __init__(self, robot: DeployedRobot, loop: ControlLoop[eqx.Module], path: Path):
        """Trace all functions and convert them to C.

        Raises:
            UnsupportedError: a step uses a primitive that has no form in C.
        """
        self.robot, self.loop, self.path = robot, loop, path
        self._names = Names()
        self.structs = structs_of(loop)
        self.estimator, self.controller, self.reading, self.estimate = self.structs
        self.functions = list(self._functions())

    def _functions(self) -> Iterator[Function]:
        loop, path, drives = self.loop, self.path, self.robot.drives
        estimator, controller, reading, estimate = (
            Argument(struct.name, struct) for struct in self.structs
        )
        pose, dt, time = (
            Argument.plain(*one) for one in (("pose", (3,)), ("dt", ()), ("time", ()))
        )
        reference = Argument.plain("reference", (6,))
        twist, command = Argument.plain("twist", (3,)), Argument.plain("command", (drives,)).made

        def begin(pose: jax.Array) -> tuple[object, object]:
            return loop.init(pose).estimator, loop.init(pose).controller

        def follow(time: jax.Array, pose: jax.Array, dt: jax.Array) -> object:
            return loop.controller.follow(path, time, pose, dt)

        asked = controller.changed, reference, estimate, dt, twist.made
        move = controller.changed, twist, estimate, dt, command
        for name, run, arguments in (
            ("slipid_begin", begin, (estimator.made, controller.made, pose)),
            ("slipid_nothing", lambda: Readings.nothing(drives), (reading.made,)),
            (
                "slipid_observe",
                loop.estimator.step,
                (estimator.changed, reading, dt, estimate.made),
            ),
            ("slipid_asked", loop.controller.asked, asked),
            ("slipid_move", loop.controller.drive, move),
            ("slipid_rearm", loop.controller.rearmed, (controller.changed,)),
            ("slipid_follow", follow, (time.changed, pose, dt, reference.made)),
        ):
            yield function(self._names, name, arguments, run)

    @property
    def kept(self) -> int:
        """Total size of the states of estimator, controller and path [numbers]."""
        return sum(f.size for s in (self.estimator, self.controller) for f in s.fields) + 1

    @property
    def scratch(self) -> int:
        """Largest total size of a function's arrays on the stack [numbers]."""
        return max(f.scratch for f in self.functions)

    def header(self) -> str:
        """Return the text of slipid.h."""
        robot = self.robot
        names = identifiers(robot.labels, "floor")
        defines = [
            f"SLIPID_WHEELS {robot.wheels}",
            f"SLIPID_DRIVES {robot.drives}",
            f"SLIPID_FLOORS {len(robot.labels)}",
            *(f"SLIPID_FLOOR_{name.upper()} {k}" for k, name in enumerate(names)),
            f"SLIPID_PATH_SECONDS {self.path.duration!r}",
        ]
        begin = ", ".join(f"{float(x):g}" for x in self.path.rows[0, :3])
        values = {
            "HEAD": _comment(*header(robot)),
            "ROBOT": robot.record.numbers,
            "DEFINES": [f"#define {d}" for d in defines],
            "ABOUT": [line for part in about(self.loop) for line in _comment(part)],
            "FOLLOWABOUT": _comment(
                "Advance the time of the path [s], which begins at 0, and return the reference at "
                "the new time, for a robot at a pose. "
                f"The path begins at {begin} [m, m, rad] and lasts {self.path.duration:g} s; its "
                "time waits for a robot that lags."
            ),
            **{s.name.upper(): _definition(s) for s in self.structs},
            **{
                f.name.removeprefix("slipid_").upper(): folded(f"{f.head};", "")
                for f in self.functions
            },
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


def about(loop: ControlLoop[eqx.Module]) -> Iterator[str]:
    """Yield sentences about axes, wheels, sensors and floors, for comments in slipid.h."""
    robot = loop.controller.robot
    yield (
        "Axes of the body: x ahead, y left, angles counter-clockwise. Axes of the world: the axes "
        "in which the start pose is given. A twist is in the body's axes."
    )
    for k, (x, y) in enumerate(robot.places.tolist()):
        drive = robot.drive_of[k] if robot.drive_of else k
        row = robot.forward[drive].tolist()
        ahead = math.degrees(math.atan2(row[1], row[0]))
        motor = f", turned by motor {drive}" if robot.drive_of else ""
        yield (
            f"Wheel {k} is at x = {x:.4f} m, y = {y:.4f} m{motor}; with a positive speed it pushes "
            f"the body in the direction {ahead:.1f} deg."
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
    return ("/* " + "\n   ".join(lines) + " */").split("\n")


def _definition(struct: Struct) -> Sequence[str]:
    """Return the lines of C that define a struct."""
    lines = ["typedef struct {"]
    for field in struct.fields:
        size = f"[{field.size}]" if field.shape else ""
        shape = "" if len(field.shape) < 2 else f", {' x '.join(map(str, field.shape))} by rows"
        declared = f"  {C_TYPES[field.numbers]} {field.name}{size};"
        comment = f"{field.about}{shape}"
        if len(declared) + len(comment) + 7 <= CODE_WIDTH:
            lines.append(f"{declared} /* {comment} */")
        else:
            lines += [*(f"  {line}" for line in _comment(comment)), declared]
    return [*lines, f"}} slipid_{struct.name};"]
