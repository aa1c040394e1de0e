"""A new config as a file: text that was read back before it is written."""

from dataclasses import dataclass
from pathlib import Path

from slipid.job.config import Wheels, geometry, parsed
from slipid.job.new.drawing import drawing
from slipid.job.new.lines import all_asked
from slipid.job.new.questions import robot_of
from slipid.job.new.sketch import Sketch
from slipid.job.new.template import blocks_of
from slipid.support.errors import DataError
from slipid.support.files import write_bytes


@dataclass(frozen=True)
class NewConfig:
    """A config that reads: its text, the robot in it, its drawing and what is still open."""

    text: str
    robot: Wheels
    drawing: str
    questions: tuple[str, ...]

    def write(self, out: Path, force: bool = False) -> None:
        """Write it; DataError where the file exists and shall not be replaced."""
        absent(out, force)
        write_bytes(out, self.text.encode())


def absent(out: Path, force: bool) -> None:
    """DataError where a file exists and shall not be replaced; said before anything is asked."""
    if out.exists() and not force:
        raise DataError(f"{out}: exists already; expected a new file, or --force")


def new_config(sketch: Sketch, name: str) -> NewConfig:
    """The config of a sketch, checked as if it had been read.

    Args:
        sketch: what it shall say.
        name: what the file will be called.

    Raises:
        DataError: the answers make no robot.
    """
    robot = robot_of(sketch.robot)
    picture = drawing(geometry(robot))
    blocks = blocks_of(sketch, robot, picture, name)
    text = "\n\n".join(block.text() for block in blocks) + "\n"
    parsed(Path(name), text)
    return NewConfig(text, robot, picture, all_asked(blocks))
