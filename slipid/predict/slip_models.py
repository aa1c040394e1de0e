"""Slip models that are compared with the force balance, fitted floor by floor.

`slip_models` returns the models before they are fitted, `restored` builds fitted models from files.
`FloorModels` fits a model to the windows of each floor, `ByFloor` to the runs of each floor.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from slipid.data.windows import Windows
from slipid.model.geometry import Geometry
from slipid.model.robot import Robot
from slipid.predict.curves import CurveModel, Saturating, above, powers, ramps, soft_torque
from slipid.predict.kinematics import (
    TERMS,
    Calibrated,
    Corrected,
    Encoder,
    HeadingLookup,
    Together,
    nominal,
)
from slipid.predict.slip_model import (
    Increments,
    PredictedRun,
    RobotSpec,
    Run,
    RunSignals,
    SlipModel,
    as_increments,
    body_twist,
    setups,
)
from slipid.predict.steps import Steps, TrainingWindows, TwistModel


@dataclass(frozen=True)
class FloorModels:
    """A slip model fitted separately for every floor.

    Predicted marker increments are compared with poses that the fitted camera corrects.

    Attributes:
        model: the slip model, not fitted.
        fitted: the fitted models, keyed by floor, or by `floor@load` for a model that is fitted to
            each load set-up separately.
    """

    model: TwistModel
    fitted: Mapping[str, TwistModel] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the model."""
        return self.model.name

    @property
    def state(self) -> dict[str, np.ndarray]:
        """Coefficients with the keys of `fitted`, from which `restored` rebuilds the models."""
        return {key: m.coefficients for key, m in self.fitted.items() if m.coefficients is not None}

    def with_state(self, state: Mapping[str, np.ndarray]) -> "FloorModels":
        """Return the models with coefficients in the form of the property `state`."""
        models = {
            k: replace(self.fitted.get(k, self.model), coefficients=v) for k, v in state.items()
        }
        return replace(self, fitted=models)

    def fit(self, w: Windows, robot: Robot) -> "FloorModels":
        """Return the model fitted to these windows, floor by floor."""
        if not self.model.learns:
            return self
        spec = RobotSpec.of(robot)
        windows = {key: training_windows(part, robot) for key, part in self._parts(w).items()}
        fitted = {key: self.model.learn(part, spec) for key, part in windows.items()}
        return replace(self, fitted=fitted)

    def twist(self, w: Windows, robot: Robot) -> np.ndarray:
        """Return the body twist of every window (segment, window, 3) [m/s, m/s, rad/s]."""
        spec, out, keys = RobotSpec.of(robot), np.empty((*w.dt.shape, 3)), self.keys(w)
        for key in dict.fromkeys(keys.tolist()):
            mine = keys == key
            steps = steps_of(w.segments(np.flatnonzero(mine)))
            model = self.fitted.get(key, self.model)
            out[mine] = model.twist(steps, spec).reshape(out[mine].shape)
        return out

    def increments(self, w: Windows, robot: Robot) -> Increments:
        """Return the marker increments of every window [m, m, rad]."""
        return as_increments(self.twist(w, robot), w, robot)

    def keys(self, w: Windows) -> np.ndarray:
        """Return the key of the model of every segment."""
        return np.array([self.key_of(s, load) for s, load in zip(w.surface, w.load, strict=True)])

    def key_of(self, surface: str, load: str) -> str:
        """Return the key of the model of a floor and load set-up.

        For a load set-up that was not fitted, it is the key of the floor's first load set-up.

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
        """Return the precision that ridges and bounds add to coefficients; keys as in `fitted`."""
        spec, parts = RobotSpec.of(robot), self._parts(w)
        return {
            key: model.stiffness(training_windows(parts[key], robot), spec)
            for key, model in self.fitted.items()
        }

    def _parts(self, w: Windows) -> dict[str, Windows]:
        """Return the windows, keyed by the key of the model that is fitted to them."""
        keys = np.array(setups(w) if self.model.by_load else w.surface)
        return {k: w.segments(np.flatnonzero(keys == k)) for k in dict.fromkeys(keys.tolist())}


def steps_of(w: Windows) -> Steps:
    """Convert windows to steps: segments become runs, and currents become their magnitudes."""
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
    """Return training windows of one step each, with their measured body twists."""
    twist, run = body_twist(w, robot).reshape(-1, 3), np.repeat(w.run, w.dt.shape[1])
    return TrainingWindows(steps_of(w), np.arange(w.dt.size), w.dt.ravel(), twist, run)


LEAST_RUNS = 5
"""Smallest number of runs on a floor, or with a load set-up, to which a model is fitted separately.

Groups with fewer runs use the model fitted to all runs.
"""
KNOTS = (0.0, 0.02, 0.04, 0.06, 0.1, 0.15, 0.25)
"""Knots of the monotone spline [N m]."""
PAPER_THRESHOLD = 0.4
"""Current above which the deployed form of the 2021 paper corrects slip [A]."""


def slip_models(
    shape: Geometry, has_current: bool, together: Together | None = None
) -> list[FloorModels]:
    """Return every slip model, before its fit, that the logged channels and the wheels allow.

    The model `paper` is the form that the authors of the 2021 paper ran on their robot; its
    threshold, and the knots of the spline, suit motors of similar size.

    Args:
        shape: geometry of the robot as in its config. Wheels that do not determine the twist
            have other models than wheels that do.
        has_current: True if currents are logged.
        together: group number of every run; a model's inner cross-validation holds out the runs of
            a group together.
    """
    models: list[TwistModel] = [nominal(shape), Encoder()]
    models.append(Calibrated(shape=shape))
    if shape.determines_twist:
        models += _of_wheels(has_current, together)
    else:
        models += [Corrected(name, shape) for name in TERMS]
    return [FloorModels(model) for model in models]


def _of_wheels(has_current: bool, together: Together | None) -> list[TwistModel]:
    """Return models for wheels that determine the twist: slip curves, and a table of headings."""
    out: list[TwistModel] = []
    if has_current:
        out = [
            CurveModel("linear", powers(1), soft_torque),
            CurveModel("affine", powers(0, 1), soft_torque),
            CurveModel("svr", powers(0, 1), soft_torque, insensitive=True),
            CurveModel("quadratic", powers(0, 1, 2), soft_torque),
            Saturating(),
            CurveModel("monotone_spline", ramps(KNOTS), soft_torque, monotone=True),
            CurveModel("affine_current", powers(0, 1)),
            CurveModel("paper", above(PAPER_THRESHOLD), per_wheel=True),
        ]
    return [*out, HeadingLookup(ridge=None, together=together)]


def restored(shape: Geometry, states: Mapping[str, Mapping[str, Sequence]]) -> list[FloorModels]:
    """Return slip models from their states, keyed by name: `{model.name: model.state}`."""
    known = {model.name: model for model in slip_models(shape, has_current=True)}
    if unknown := sorted(set(states) - set(known)):
        raise ValueError(f"no model '{unknown[0]}'; expected one of {', '.join(known)}")
    return [
        known[name].with_state({floor: np.asarray(v, float) for floor, v in state.items()})
        for name, state in states.items()
    ]


@dataclass(frozen=True)
class ByFloor(SlipModel):
    """A slip model fitted to each floor separately if floors are known, else to each load set-up.

    Groups of fewer than `LEAST_RUNS` runs use the model fitted to all runs.

    Attributes:
        method: the model, not fitted.
        pooled: True if floors and loads are ignored and the model is fitted once to all runs.
        fitted: the model fitted to the runs of each group, keyed by the group's name, the largest
            group first; if `pooled`, the only key is None.
    """

    method: SlipModel
    pooled: bool = False
    fitted: Mapping[str | None, SlipModel] = field(default_factory=dict)

    @classmethod
    def of(cls, method: SlipModel) -> "ByFloor":
        return cls(method.name, method, needs=method.needs, aim=method.aim)

    def candidates(self) -> Sequence["ByFloor"]:
        return [replace(self, method=method) for method in self.method.candidates()]

    def fit(self, runs: Sequence[Run], spec: RobotSpec) -> "ByFloor":
        groups: dict[str | None, list[Run]] = {}
        for run in runs:
            groups.setdefault(self.group_of(run.signals), []).append(run)
        order = sorted(groups, key=lambda name: -len(groups[name]))
        few = [name for name in order if len(groups[name]) < LEAST_RUNS] if len(order) > 1 else []
        fitted = {n: self.method.fit(groups[n], spec) for n in order if n not in few}
        if few:
            fitted |= dict.fromkeys(few, self.method.fit(runs, spec))
        return replace(self, fitted=fitted)

    def predict(self, runs: Sequence[RunSignals], spec: RobotSpec) -> list[PredictedRun]:
        found: dict[int, PredictedRun] = {}
        groups = [self._fitted_group(run) for run in runs]
        for group in dict.fromkeys(groups):
            mine = [k for k, name in enumerate(groups) if name == group]
            of_group = self.fitted[group].predict([runs[k] for k in mine], spec)
            found.update(zip(mine, of_group, strict=True))
        return [found[k] for k in range(len(runs))]

    def _fitted_group(self, signals: RunSignals) -> str | None:
        """Return the group of a run, or the largest group if its load set-up was not trained.

        Raises:
            ValueError: the floor of the run was not fitted.
        """
        group = self.group_of(signals)
        if group not in self.fitted:
            if signals.floor is not None:
                known = ", ".join(map(str, self.fitted))
                raise ValueError(f"{self.name}: no floor '{signals.floor}'; fitted: {known}")
            return next(iter(self.fitted))
        return group

    def group_of(self, signals: RunSignals) -> str | None:
        """Return the group of a run: its floor if known, else its load set-up; None if pooled."""
        if self.pooled:
            return None
        return signals.load if signals.floor is None else signals.floor

    @property
    def numbers(self) -> int:
        return sum(method.numbers for method in {id(m): m for m in self.fitted.values()}.values())
