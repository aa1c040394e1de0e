"""Files of a C folder: the code, its test, an example, and what builds them."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jaxtyping import Float

from slipid.control.closed_loop import Pilot
from slipid.control.deployed import DeployedRobot
from slipid.control.export.c99.code import Code, filled, template
from slipid.control.export.c99.golden_header import golden_header
from slipid.control.export.header import facts, made_with, warned
from slipid.control.trajectory import Path


@dataclass(frozen=True)
class Recording:
    """A run of a path that the library has driven, a row per period.

    Attributes:
        plant: what it was driven on; start: pose at which it began [m, m, rad].
        given: dt [s] and the leaves of the reading; command: wheel speeds [rad/s].
        time: of the path [s].
    """

    plant: str
    start: tuple[float, float, float]
    given: Float[np.ndarray, "step given"]
    command: Float[np.ndarray, "step wheel"]
    time: Float[np.ndarray, " step"]

    @property
    def readings(self) -> str:
        """Text of readings.txt, which the example reads."""
        rows = [" ".join(repr(float(x)) for x in row) for row in self.given]
        return "\n".join([" ".join(map(repr, self.start)), *rows]) + "\n"

    @property
    def commands(self) -> str:
        """Text of commands.txt, as the example prints it."""
        rows = zip(self.command, self.time, strict=True)
        return "".join(f"{' '.join(f'{x:.9f}' for x in c)} {t:.9f}\n" for c, t in rows)


def _path(path: Path) -> str:
    """Description of a path for people."""
    corners = [f"({x:.2f}, {y:.2f})" for x, y in np.asarray(path.corners).tolist()]
    x, y, heading = np.asarray(path.rows)[0, :3].tolist()
    return (
        f"from ({x:.2f}, {y:.2f}), heading {heading:.2f} rad, over {', '.join(corners)} [m] in "
        f"{path.duration:g} s"
    )


def _kib(numbers: int) -> str:
    """Size of so many numbers in `double`."""
    return f"{numbers * 8 / 1024:.1f} KiB"


def c_files(
    robot: DeployedRobot,
    pilot: Pilot[eqx.Module],
    path: Path,
    recording: Recording | None = None,
) -> dict[str, str]:
    """Text of the files by their paths in the folder.

    Args:
        robot: for the record of its numbers; pilot: its estimator and controller.
        path: that the example follows.
        recording: a run of it, as a test of the example.

    Raises:
        UnsupportedError: a step uses a primitive that has no form in C.
    """
    code = Code(robot, pilot, path)
    named = {"VERSION": made_with()}
    files = {
        "src/slipid.h": code.header(),
        "src/slipid.c": code.source(),
        "test/golden.h": golden_header(code),
        "test/check.c": template("check.c"),
        "examples/drive/drive.c": template("drive.c"),
        "examples/Slipid/Slipid.ino": filled("Slipid.ino", {"STACK": _kib(code.scratch)}),
        "CMakeLists.txt": template("CMakeLists.txt"),
        "library.json": filled("library.json", named),
        "library.properties": filled("library.properties", named),
    }
    steps = ""
    if recording is not None:
        files["examples/drive/readings.txt"] = recording.readings
        files["examples/drive/commands.txt"] = recording.commands
        steps = filled("recording.md", {"PLANT": recording.plant})
    values = {
        "WARNINGS": "\n".join(warned(robot)),
        "HEAD": "\n".join(facts(robot)),
        "RECORDING": steps,
        "FLOORS": ", ".join(f"`{name}` ({k})" for k, name in enumerate(robot.labels)),
        "WHEELS": str(robot.wheels),
        "STATE": _kib(code.kept),
        "STACK": _kib(code.scratch),
        "PATH": _path(path),
    }
    files["README.md"] = filled("README.md", values)
    return files
