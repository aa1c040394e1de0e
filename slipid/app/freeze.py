"""From a fit to what runs on the robot: frozen at the fitted numbers, or at posterior draws."""

from hashlib import sha256
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from slipid.control.estimator import MIXED, Settings
from slipid.control.frozen import Frozen, freeze
from slipid.control.habits import Habits
from slipid.data.log import DataError
from slipid.identify.result import Fit


def sensors_of(fit: Fit, gyro: bool) -> tuple[Settings, Habits]:
    """What the estimator and the twin of a fit's robot count on: the sensors of its logs.

    One that has learnt from runs over several floors expects to drive on several.

    Args:
        fit: as `slipid identify` left it.
        gyro: whether the robot has one.
    """
    signed = bool(fit.settings["current_is_signed"])
    habits = Habits(voltage=bool(fit.has["voltage"]), gyro=gyro, signed=signed)
    mixed = {"alike": MIXED} if "mixed" in fit.settings else {}
    return Settings(current_is_signed=signed, **mixed), habits


def fit_hash(fit: Fit) -> dict[str, str]:
    """Of the runs a fit was made of, and of its numbers."""
    numbers = sha256(np.asarray(fit.z, "<f8").tobytes())
    numbers.update(np.asarray(fit.covariance, "<f8").tobytes())
    return {"data": fit.data_hash, "numbers": numbers.hexdigest()}


def load_of(fit: Fit, load: str | None) -> str:
    """Name of a load set-up, the first one where none is asked for.

    Raises:
        DataError: no such load set-up; names those there are.
    """
    loads = fit.robot.body.loads
    if load is not None and load not in loads:
        raise DataError(f"no load set-up '{load}'; identified: {', '.join(loads)}")
    return loads[0] if load is None else load


def frozen_of(fit: Fit, load: str | None = None, draws: int = 64, seed: int = 0) -> Frozen:
    """Frozen form of a fit, its posterior's spread counted in `Frozen.effect`.

    Args:
        fit: as `slipid identify` left it.
        load: name of the load set-up it drives with, the first one by default.
        draws: of the posterior, for the spread; 0 for none.
        seed: of the draws.

    Raises:
        DataError: no such load set-up.
    """
    name = load_of(fit, load)
    several = _trees(fit, draws, seed) if draws else None
    return freeze(fit.robot, name, _stds(fit), several, _highest(fit), fit.current_trend)


def frozen_draws(fit: Fit, load: str | None = None, draws: int = 16, seed: int = 0) -> Frozen:
    """The robots that a fit holds possible: `Frozen` with a leading axis of posterior draws.

    What runs differ by stays in `Frozen.effect`; the spread of the numbers is in the draws.

    Args:
        fit, load, seed: as `frozen_of` has them.
        draws: how many.

    Raises:
        DataError: no such load set-up.
    """
    name, std, top = load_of(fit, load), _stds(fit), _highest(fit)
    trees = _trees(fit, draws, seed)
    one = [
        freeze(jax.tree.map(lambda x, k=k: x[k], trees), name, std, None, top, fit.current_trend)
        for k in range(draws)
    ]
    stacked: Frozen = jax.tree.map(lambda *leaves: jnp.stack(leaves), *one)
    return stacked


def _trees(fit: Fit, draws: int, seed: int) -> Any:
    return jax.vmap(fit.space.tree)(jnp.asarray(fit.draws(draws, seed)))


def _stds(fit: Fit) -> dict[str, float]:
    return {name: float(v) ** 0.5 for name, v in fit.variance.items()}


def _highest(fit: Fit) -> float | None:
    """Largest wheel speed of the fitted runs [rad/s]."""
    seen = [max(abs(x) for x in v["wheel_speed"]) for v in fit.validity.values() if v]
    return max(seen) if seen else None
