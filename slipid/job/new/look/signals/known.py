"""What files of a run tell of each other, and further runs of what one does not show."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from slipid.job.new.answers import Answers
from slipid.job.new.look.columns.found import Found
from slipid.job.new.look.signals.study import (
    Motion,
    Study,
    driven_backwards,
    motion,
    over_wheels,
    pose_study,
    signed,
)

CURRENTS = ("current", "motor_torque", "wheel_torque")
SPEEDS = ("wheel_speed", "motor_speed")
ANGLES = ("wheel_angle", "motor_angle")


@dataclass(frozen=True, eq=False)
class Known:
    """What files of a run tell of each other.

    Attributes:
        robot: its sizes, as far as they are known.
        main: the file that has the wheels; `all`: every file of the run.
        others: the same of further runs, for what a single run may not show.
    """

    robot: Answers
    main: Study
    all: tuple[Study, ...]
    others: tuple["Known", ...] = ()

    @cached_property
    def moved(self) -> Motion:
        """Motion by the pose."""
        return motion(pose_study(self.all))

    def find(self, *channels: str) -> Found | None:
        """The first of some channels, in any of the files."""
        found = (one.columns.get(name) for name in channels for one in self.all)
        return next((one for one in found if one is not None), None)

    @property
    def runs(self) -> tuple["Known", ...]:
        """This run, and the others."""
        return (self, *self.others)

    @cached_property
    def over_wheels(self) -> float | None:
        """Speed of the pose over that of the wheels, the middle one of all runs."""
        found = []
        for run in self.runs:
            speed = run.main.columns.first(*SPEEDS)
            angle = run.main.columns.first(*ANGLES)
            if speed is None and angle is not None and run.main.clock is not None:
                rates = np.gradient(angle.values, run.main.time, axis=0)
                speed = replace(angle, values=rates)
            ratio = None if speed is None else over_wheels(run.main, speed, run.moved)
            found += [ratio] if ratio is not None else []
        return float(np.median(found)) if found else None

    @property
    def signed(self) -> bool | None:
        """Whether currents have a sign in any of the runs; None where none tells."""
        said = [
            signed(current, run.find(*SPEEDS))
            for run in self.runs
            if (current := run.find(*CURRENTS)) is not None
        ]
        return True if True in said else False if False in said else None

    @property
    def of_supply(self) -> bool:
        """Whether currents are what the battery gives: positive both ways, negative at times."""
        currents = [(run.find(*CURRENTS), run.find(*SPEEDS)) for run in self.runs]
        known = [(current, speed) for current, speed in currents if current is not None]
        both_ways = any(driven_backwards(current, speed) for current, speed in known)
        return both_ways and any(np.nanmin(current.values) < 0.0 for current, _ in known)

    @property
    def radius(self) -> float | None:
        """Wheel radius, where somebody said it [m]."""
        taken = "wheel_radius_m" in self.robot.taken
        return None if taken else self.robot.wheel_radius_m
