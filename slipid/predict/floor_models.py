"""Slip models with numbers of their own for every floor, on the windows of a fitted robot."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from slipid.data.windows import Windows
from slipid.model.robot import Robot
from slipid.predict.slip_model import Increments, Machine, RunSignals, as_increments, body_twist
from slipid.predict.steps import Steps, TrainingWindows, TwistModel


@dataclass(frozen=True)
class FloorModels:
    """A slip model that turns wheel motion into marker increments, in corrected metres.

    Attributes:
        model: unfitted.
        fitted: to the windows of each floor, or of each `floor@load` where the model asks for it.
    """

    model: TwistModel
    fitted: Mapping[str, TwistModel] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the model."""
        return self.model.name

    @property
    def state(self) -> dict[str, np.ndarray]:
        """Fitted numbers by floor: with the name, enough to build the models again."""
        return {key: m.coefficients for key, m in self.fitted.items() if m.coefficients is not None}

    def with_state(self, state: Mapping[str, np.ndarray]) -> "FloorModels":
        """The models with these numbers."""
        models = {
            k: replace(self.fitted.get(k, self.model), coefficients=v) for k, v in state.items()
        }
        return replace(self, fitted=models)

    def fit(self, w: Windows, robot: Robot) -> "FloorModels":
        """The model fitted to these windows, floor by floor."""
        if not self.model.learns:
            return self
        machine = Machine.of(robot)
        windows = {key: training_windows(part, robot) for key, part in self._parts(w).items()}
        fitted = {key: self.model.learn(part, machine) for key, part in windows.items()}
        return replace(self, fitted=fitted)

    def twist(self, w: Windows, robot: Robot) -> np.ndarray:
        """Body twist of every window (piece, window, 3) [m/s, m/s, rad/s]."""
        machine, out = Machine.of(robot), np.empty((*w.dt.shape, 3))
        keys = np.array([self.series(s, load) for s, load in zip(w.surface, w.load, strict=True)])
        for key in dict.fromkeys(keys.tolist()):
            mine = keys == key
            steps = steps_of(w.segments(np.flatnonzero(mine)))
            model = self.fitted.get(key, self.model)
            out[mine] = model.twist(steps, machine).reshape(out[mine].shape)
        return out

    def increments(self, w: Windows, robot: Robot) -> Increments:
        """Marker increments of every window [m, m, rad]."""
        return as_increments(self.twist(w, robot), w, robot)

    def series(self, surface: str, load: str) -> str:
        """Key of the model of a floor and load set-up.

        A load set-up that was not fitted takes the one the floor was first driven with.

        Raises:
            ValueError: the floor was not fitted.
        """
        if not self.model.learns:
            return surface
        if (exact := f"{surface}@{load}") in self.fitted:
            return exact
        floors = {key.rpartition("@")[0] or key: key for key in reversed(list(self.fitted))}
        if surface not in floors:
            raise ValueError(f"no surface '{surface}'; identified: {', '.join(reversed(floors))}")
        return floors[surface]

    def stiffness(self, w: Windows, robot: Robot) -> dict[str, np.ndarray]:
        """Precision of each key's flat numbers by what holds them besides the data."""
        machine, parts = Machine.of(robot), self._parts(w)
        return {
            key: model.stiffness(training_windows(parts[key], robot), machine)
            for key, model in self.fitted.items()
        }

    def _parts(self, w: Windows) -> dict[str, Windows]:
        """Windows by the key of the model that is fitted to them."""
        setups = [f"{s}@{load}" for s, load in zip(w.surface, w.load, strict=True)]
        keys = np.array(setups if self.model.by_load else w.surface)
        return {k: w.segments(np.flatnonzero(keys == k)) for k in dict.fromkeys(keys.tolist())}


def steps_of(w: Windows) -> Steps:
    """The windows as steps, each piece a run of its own; of currents their magnitudes."""
    drives = w.turn.shape[-1]
    signals = RunSignals(
        name="windows",
        dt=w.dt.ravel(),
        turn=w.turn.reshape(-1, drives),
        current=np.abs(w.current).reshape(-1, drives) if w.has_current else None,
    )
    first = np.arange(len(w)) * w.dt.shape[1]
    return Steps(signals, first, w.speed_change.reshape(-1, drives), w.lag)


def training_windows(w: Windows, robot: Robot) -> TrainingWindows:
    """The windows with the body twists that were measured in them, each a step."""
    twist, run = body_twist(w, robot).reshape(-1, 3), np.repeat(w.run, w.dt.shape[1])
    return TrainingWindows(steps_of(w), np.arange(w.dt.size), w.dt.ravel(), twist, run)
