"""Quann and others predict energy by a law of the motion and a Gaussian process of the place.

In `quann_energy` the energy per metre  y = P / max(|v|, 0.02)  is linear in (1, |v|, |v|^2, |W|),
plus a Gaussian process of the place. Power is predicted from encoders alone as  y max(|v|, 0.02).

One setting is tuned, by the energy of whole runs: the length of the map.

Liberties:
    - The papers map energy over places that a robot team shares; here the map is relative to where
      and how a run starts, since no absolute place is given.
    - A thousand windows are drawn at random instead of taking all, slow ones less often.
    - The linear law is found by least squares weighted by max(|v|, 0.02)^2, which is least squares
      of power. The process of what is left follows, with the length given and its variances by
      marginal likelihood.
    - Beyond speeds and yaw rates that were seen the law says what it says of the fastest seen: one
      fitted at a single speed is off a hundredfold at twice that speed.
    - Power is that of the motors by currents and datasheet, not of the whole robot.
    - The path is the encoders'.

Source: Quann, Ojeda, Smith, Rizzo, Castanier, Barton 2017, An energy-efficient method for
multi-robot reconnaissance in an unknown environment, American Control Conference; the same 2020,
Power prediction for heterogeneous ground robots through spatial mapping and sharing of terrain
data, IEEE Robotics and Automation Letters 5(2).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from jaxtyping import Float

from slipid.baselines.motion.features import Windows, at_steps
from slipid.baselines.motion.quann.gaussian_process import Kernel, Process, Rows
from slipid.identify.compare.slip_model import (
    Aim,
    Channel,
    Heard,
    Machine,
    Run,
    Said,
    SlipModel,
    Twists,
    path_of,
)

SLOW = 0.02
"""Speed below which energy is counted per time instead of per way [m/s]."""


@final
@dataclass(frozen=True, eq=False)
class QuannEnergy(SlipModel):
    """Energy per metre as a linear law of the motion and a Gaussian process of the place.

    Attributes:
        length: of the map [m].
        law: coefficients of (1, |v|, |v|^2, |W|).
        fastest: |v| and |W| that were seen [m/s], [rad/s].
        process: of what the law leaves, at places seen from the start of a run.
    """

    name: str = "quann_energy"
    needs: frozenset[Channel] = field(default=frozenset({"current"}), kw_only=True)
    aim: Aim = field(default="energy", kw_only=True)
    length: float = 0.2
    law: Float[np.ndarray, "4"] | None = None
    fastest: Float[np.ndarray, "2"] | None = None
    process: Process | None = None

    def candidates(self) -> Sequence["QuannEnergy"]:
        return [replace(self, length=length) for length in (0.1, 0.2, 0.5)]

    def fit(self, runs: Sequence[Run], machine: Machine) -> "QuannEnergy":
        windows = Windows.of([run.heard for run in runs], machine)
        way, motion = rate(windows.rolling), motions(windows.rolling)
        energy = np.concatenate([run.power(machine) for run in windows.heard]) / way
        terms = law_terms(motion)
        law = np.linalg.lstsq(terms * way[:, None], energy * way, rcond=1e-6)[0]
        left = (energy - terms @ law)[:, None]
        rows = Rows(places(windows, machine), left, way**2)
        kernel = Kernel((self.length,), free=False).tuned(rows)
        process = Process.of(rows, kernel)
        return replace(self, law=law, fastest=motion.max(axis=0), process=process)

    def predict(self, runs: Sequence[Heard], machine: Machine) -> list[Said]:
        if self.process is None or self.law is None or self.fastest is None:
            raise ValueError(f"{self.name}: predict before fit")
        windows = Windows.of(runs, machine)
        left = self.process.predict(places(windows, machine)).mean
        motion = np.minimum(motions(windows.rolling), self.fastest)
        energy = law_terms(motion) @ self.law + left[:, 0]
        rolling = [run.rolling(machine) for run in runs]
        of_steps = at_steps(energy[:, None], windows, runs)
        return [
            Said(path_of(twist, run.dt), power=energy_of_run[:, 0] * rate(twist))
            for run, twist, energy_of_run in zip(runs, rolling, of_steps, strict=True)
        ]

    @property
    def numbers(self) -> int:
        return 0 if self.process is None else 4 + self.process.numbers


def rate(twist: Twists) -> Float[np.ndarray, " row"]:
    """Speed [m/s], not less than `SLOW`."""
    return motions(twist)[:, 0].clip(min=SLOW)


def motions(twist: Twists) -> Float[np.ndarray, "row 2"]:
    """|v| [m/s] and |W| [rad/s]."""
    return np.stack([np.hypot(twist[:, 0], twist[:, 1]), np.abs(twist[:, 2])], axis=1)


def law_terms(motion: Float[np.ndarray, "row 2"]) -> Float[np.ndarray, "row 4"]:
    """(1, |v|, |v|^2, |W|)."""
    speed, turning = motion.T
    return np.stack([np.ones_like(speed), speed, speed**2, turning], axis=1)


def places(windows: Windows, machine: Machine) -> Float[np.ndarray, "window 2"]:
    """Place in the middle of each window by the encoders, seen from the run's start [m]."""
    paths = [path_of(run.rolling(machine), run.dt)[:, :2] for run in windows.heard]
    return np.concatenate([0.5 * (path[1:] + path[:-1]) for path in paths])
