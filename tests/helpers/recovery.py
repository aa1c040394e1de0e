"""Recovery of known truth from made logs: the test does it for few seeds, the benchmark for 40."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from slipid.data.runs import collect
from slipid.data.windows import windows
from slipid.fitting.optimise import optimise
from slipid.fitting.problem import Problem
from slipid.infer.slip_curves import curves, slip_on
from slipid.infer.verdicts.estimates import by_ratio, from_zero
from slipid.lab.selftest.logs import (
    SimulatedSensors,
    heading_grid,
    nominal_robot,
    simulate_logs,
    true_robot,
)
from slipid.search_space import Choice, Space

SETUPS = (("firm", "as_built"), ("soft", "as_built"), ("soft", "moved"))
PLAN = heading_grid(SETUPS, headings=8, turns=1)
TRUTH = true_robot(PLAN)
LAG = 0.05


def choices(robot=TRUTH, factor=2.0):
    """Every motor and surface number starts this factor off the truth, up and down in turn."""
    known = [
        Choice("camera.scale", prior_mean=1.117, prior_std=0.002),
        Choice("camera.lag", prior_mean=LAG, prior_std=0.01),
        Choice("camera.marker_yaw", free=True),
        Choice("robot.mass", fixed=12.0),
    ]
    free = [
        e
        for e in Space(robot, known).free
        if e.path.startswith(("surface.", "motor.")) and not e.declaration.deviation
    ]
    return known + [
        Choice(e.path, start=float(e.get(robot)) * factor ** (1 if k % 2 else -1))
        for k, e in enumerate(free)
    ]


@functools.cache
def problem(voltage=True):
    """A compiled problem of the plan's shape, and its choices."""
    cut = windows(dataset(0, voltage), 0.04, LAG)
    return Problem(cut, nominal_robot(PLAN), choices())


@functools.cache
def dataset(seed, voltage=True):
    return collect(simulate_logs(TRUTH, PLAN, seed, SimulatedSensors(has_voltage=voltage)))


@functools.cache
def design():
    """Which coordinates this plan identifies: expected information at the truth."""
    this, sensors = problem(), SimulatedSensors()
    rows = 40  # of a window
    white = {
        "window": sensors.ripple / np.sqrt(rows),
        "voltage.window": np.hypot(sensors.voltage_noise, sensors.voltage_step / 12**0.5)
        / rows**0.5,
    }
    std = [
        white.get(name, white["window"]) if name.endswith("window") else sensors.of(name)
        for name in this.noise.names
    ]
    keep = np.ones(len(this.windows))
    log_v = 2 * np.log(np.maximum(std, 1e-6))
    covariance = this.laplace(this.space.vector(TRUTH), log_v, keep)
    return said_identified(this.space, np.sqrt(np.diag(covariance)))


def said_identified(space, std):
    """Which coordinates the verdict of Laplace stds calls identified."""
    said = np.zeros(space.size, bool)
    for e in space.free:
        at = space.slices[e.path]
        for k in range(at.start, at.stop):
            ratio, apart = std[k] / space.prior_std[k], from_zero(e.declaration, std[k : k + 1])
            said[k] = by_ratio(ratio, apart) == "identified"
    return said


@dataclass(frozen=True)
class Recovered:
    """One seed: estimate, Laplace std and truth in the search space, and errors people care for.

    `identified` is the verdict of this fit; `design()` is that of the plan.
    """

    names: list[str]
    z: np.ndarray
    std: np.ndarray
    truth: np.ndarray
    identified: np.ndarray
    curve_gap: dict[str, float]
    noise: dict[str, float]
    converged: bool

    @property
    def score(self):
        return (self.z - self.truth) / self.std

    def relative_error(self, path):
        k = self.names.index(path)
        return float(np.expm1(self.z[k] - self.truth[k]))


def recover(seed):
    """Fit of one seed from the staged start, every start value off by a factor of two."""
    this = problem().of(windows(dataset(seed), 0.04, LAG))
    end = optimise(this)
    std = np.sqrt(np.diag(end.covariance))
    space = this.space
    return Recovered(
        names=space.names,
        z=end.state.z,
        std=std,
        truth=space.vector(TRUTH),
        identified=said_identified(space, std),
        curve_gap=curve_gap(this, end.state.z),
        noise=dict(zip(this.noise.names, np.exp(0.5 * end.state.log_variance), strict=True)),
        converged=end.converged,
    )


def curve_gap(this, z):
    """Largest difference in slip to the true curve over the torques visited, per floor."""
    found = curves(this.space, z, z[None], this.batch)
    return {
        floor: float(np.abs(slip_on(TRUTH, floor, curve) - curve.slip).max())
        for floor, curve in found.items()
    }
