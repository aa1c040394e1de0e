"""Which robot logs can be of: its drive by the number of wheels, and whether it goes sideways."""

from dataclasses import dataclass, replace

import numpy as np

from slipid.data.reading.units import factor
from slipid.data.wheel_signals import body_steps
from slipid.job.new.look.study import Study, pose_study
from slipid.job.new.robot_questions import RobotAnswers, RobotOptions, ask
from slipid.job.new.sketch import Hint

_SIDEWAYS = 0.3
"""Share of the way that is sideways, from which a robot can drive so."""


@dataclass(frozen=True)
class GuessedRobot:
    """A robot, with what is to be asked of it in words that fit the logs."""

    robot: RobotAnswers
    hints: tuple[Hint, ...]


def robot_from(options: RobotOptions, wheels: int, files: tuple[Study, ...]) -> GuessedRobot:
    """The robot of the options, the rest as the logs have it; DataError as of `ask`."""
    drive, hint = _drive(wheels, sideways(files))
    drive = options.drive or drive
    if wheels == 2 and drive in ("mecanum", "skid") and options.shared is None:
        options = replace(options, shared="yes")
    if wheels >= 3 and drive == "omni" and options.wheels is None and options.azimuths_deg is None:
        options = replace(options, wheels=str(wheels))
    known = ask(options, None, drive)
    if drive == "general" and options.places_m is None and wheels >= 2:
        known = _in_rows(known, wheels)
    return GuessedRobot(known, (Hint("drive", hint),))


def _drive(wheels: int, aside: bool | None) -> tuple[str, str]:
    """The likeliest drive, and the question that remains."""
    if wheels == 2:
        return (
            "differential",
            'two drives: differential, or "skid" with drives = [[1, 3], [2, 4]], half_length_m and '
            "half_width_m instead of track_m?",
        )
    if wheels == 3:
        return "omni", "three wheels: omni, or general (two driven and steered ones do not work)?"
    if wheels == 4:
        drive = "mecanum" if aside else "skid"
        moves = {True: ", it goes sideways", False: ", it never goes sideways", None: ""}[aside]
        return drive, f"four wheels{moves}: skid, mecanum or omni, in which order of the columns?"
    if wheels > 4:
        return "general", f"{wheels} wheels: where do they stand, in the order of the columns?"
    if wheels == 1:
        return "omni", "one column of wheels only: a motor on a bench (slipid motor FILE), or more?"
    return "omni", "no column tells how wheels turn: which drive is it, and how many wheels?"


def sideways(files: tuple[Study, ...]) -> bool | None:
    """Whether the robot was told to drive sideways, or did; None where nothing says."""
    for one in files:
        command = one.columns.get("twist_command_y")
        if command is not None and np.nanmax(np.abs(command.values)) > 0:
            return True
    posed = pose_study(files)
    if posed is None or (turned := posed.columns.get("pose_heading")) is None:
        return None
    if not turned.unit:
        return None
    x, y = posed.columns.get("pose_x"), posed.columns.get("pose_y")
    assert x is not None
    assert y is not None
    heading = turned.values[:, 0] * factor(turned.unit, "rad")
    pose = np.stack([x.values[:, 0], y.values[:, 0], heading], axis=1)
    steps = np.abs(body_steps(pose[~np.isnan(pose).any(axis=1)]))
    ahead, left = float(steps[:, 0].sum()), float(steps[:, 1].sum())
    return left > _SIDEWAYS * (ahead + left) if ahead + left > 0 else None


def _in_rows(known: RobotAnswers, wheels: int) -> RobotAnswers:
    """Wheels in two rows, left and right, as a place to start from; in one where they are odd."""
    pairs = wheels // 2
    places = [
        (0.2 - 0.4 * k / max(pairs - 1, 1), side) for k in range(pairs) for side in (0.15, -0.15)
    ]
    places += [(-0.3, 0.0)] * (wheels % 2)
    return replace(
        known,
        wheels=wheels,
        places_m=tuple(places),
        directions_deg=(0.0,) * wheels
        if len(known.directions_deg) != wheels
        else known.directions_deg,
        rollers_deg=(None,) * wheels if len(known.rollers_deg) != wheels else known.rollers_deg,
    )
