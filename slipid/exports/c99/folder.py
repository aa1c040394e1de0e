"""Files of a C folder: the code, its test with reference steps, an example, and build files."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jaxtyping import Float

from slipid.exports.c99.code import Code
from slipid.exports.c99.text import wrapped
from slipid.exports.description import facts, made_with, warned
from slipid.exports.feedforward import HEADER, c_header
from slipid.exports.fields import Struct
from slipid.exports.golden import golden
from slipid.exports.text import filled, template
from slipid.robot.closed_loop import ControlLoop
from slipid.robot.deployed import DeployedRobot
from slipid.robot.feedforward import robot_feedforwards
from slipid.robot.trajectory import Path

FILLED_FILES = (
    *("test/golden.h", "test/check.c", "examples/drive/drive.c", "examples/Slipid/Slipid.ino"),
    *("CMakeLists.txt", "library.json", "library.properties", "README.md"),
)
"""Files besides slipid.h and slipid.c, each written from the template with the same file name."""


def _golden(code: Code) -> dict[str, str | list[str]]:
    """Return the texts for the template of golden.h, keyed by their placeholders.

    The texts are the reference steps as tables, and C code that writes and reads the structs.
    """
    steps = golden(code.loop)
    names = [f.name for f in code.estimate.fields for _ in range(f.size)]
    return {
        "STEPS": str(len(steps.given)),
        "INPUTS": str(steps.given.shape[1]),
        "OUTPUTS": str(steps.said.shape[1]),
        "GIVEN": _table(steps.given),
        "SAID": _table(steps.said),
        "COMMAND": _table(steps.command),
        "SCALE": _words(np.maximum(np.abs(steps.said).max(axis=0), 1e-3), "  "),
        "NAMES": wrapped((f'"{name}"' for name in names), "  "),
        "FILL": _filling(code.reading),
        "READ": _reading_out(code.estimate),
    }


def _table(rows: np.ndarray) -> list[str]:
    return [line for row in rows for line in ("  {", *_words(row, "    "), "  },")]


def _words(row: np.ndarray, indent: str) -> list[str]:
    return wrapped(("NAN" if np.isnan(x) else repr(float(x)) for x in row), indent)


def _filling(struct: Struct) -> list[str]:
    names = [f"{f.name}[{k}]" if f.shape else f.name for f in struct.fields for k in range(f.size)]
    return [f"  reading->{name} = (slipid_real)row[{k}];" for k, name in enumerate(names)]


def _reading_out(struct: Struct) -> list[str]:
    lines, place = [], 0
    for field in filter(lambda field: field.size, struct.fields):
        member = f"estimate->{field.name}{'[k]' if field.shape else ''}"
        value = f"{member} ? 1.0 : 0.0" if field.numbers == "bool" else f"(double){member}"
        loop = f"for (int k = 0; k < {field.size}; ++k) out[{place} + k]"
        lines.append(f"  {loop if field.shape else f'out[{place}]'} = {value};")
        place += field.size
    return lines


@dataclass(frozen=True)
class Recording:
    """A closed-loop run along a path with slipid's own control loop, one row per control period.

    Attributes:
        plant: description of the plant.
        start: pose at which the run began [m, m, rad].
        given: inputs of each step: dt [s] and all arrays of the reading, concatenated.
        command: commanded wheel speeds [rad/s].
        time: time of the path [s], which waits for a robot that lags.
    """

    plant: str
    start: tuple[float, float, float]
    given: Float[np.ndarray, "step given"]
    command: Float[np.ndarray, "step drive"]
    time: Float[np.ndarray, " step"]

    @property
    def readings(self) -> str:
        """Text of readings.txt, which the example reads."""
        rows = [" ".join(repr(float(x)) for x in row) for row in self.given]
        return "\n".join([" ".join(map(repr, self.start)), *rows]) + "\n"

    @property
    def commands(self) -> str:
        """Text of commands.txt, which the output of the example must equal."""
        rows = zip(self.command, self.time, strict=True)
        return "".join(f"{' '.join(f'{x:.9f}' for x in c)} {t:.9f}\n" for c, t in rows)


def c_files(
    robot: DeployedRobot,
    loop: ControlLoop[eqx.Module],
    path: Path,
    recording: Recording | None = None,
) -> dict[str, str]:
    """Return the text of each file, keyed by its path in the folder.

    Args:
        robot: robot with the record of its parameters.
        loop: estimator and controller.
        path: path that the example follows.
        recording: closed-loop run along the path, whose commands the example must reproduce; None
            to omit it.

    Raises:
        UnsupportedError: a step uses a primitive that has no form in C.
    """
    code = Code(robot, loop, path)
    state, stack = (f"{numbers * 8 / 1024:.1f} KiB" for numbers in (code.kept, code.scratch))
    corners = [f"({x:.2f}, {y:.2f})" for x, y in np.asarray(path.corners).tolist()]
    x, y, heading = np.asarray(path.rows)[0, :3].tolist()
    gains = robot_feedforwards(robot)
    run: dict[str, str] = {}
    example = ""
    if recording is not None:
        run["examples/drive/readings.txt"] = recording.readings
        run["examples/drive/commands.txt"] = recording.commands
        example = filled("c99/recording.md", {"PLANT": recording.plant})
    values = {
        **_golden(code),
        "VERSION": made_with(),
        "WARNINGS": warned(robot),
        "HEAD": facts(robot),
        "RECORDING": example,
        "FEEDFORWARD": template("c99/feedforward.md") if gains else "",
        "FLOORS": ", ".join(f"`{name}` ({k})" for k, name in enumerate(robot.labels)),
        "WHEELS": str(robot.wheels),
        "DRIVES": str(robot.drives),
        "RECOVERY": "" if bool(loop.controller.recovery) else " (recovery is off in this export)",
        "STATE": state,
        "STACK": stack,
        "PATH": f"from ({x:.2f}, {y:.2f}), heading {heading:.2f} rad, over {', '.join(corners)} "
        f"[m] in {path.duration:g} s",
    }
    others = {name: filled(f"c99/{name.rpartition('/')[2]}", values) for name in FILLED_FILES}
    if gains:
        others[f"src/{HEADER}"] = c_header(gains)
    return {"src/slipid.h": code.header(), "src/slipid.c": code.source(), **others, **run}
