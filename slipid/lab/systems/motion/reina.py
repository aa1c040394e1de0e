"""Reina and others: slip detection by indicators from encoders, gyro and currents.

Slip is flagged by thresholds or by fuzzy rules. Signals (I~, w, gyro) are smoothed by a causal
exponential mean. Let J_i be the row vector that maps the body twist to the rim speed of wheel i,
w_i the wheel's speed and r its radius, xi_c the commanded twist, xi_enc the twist by the encoders
and W_enc its yaw rate. The indicators are

    w_ref,i = J_i xi_c / r  median_j(r w_j / J_j xi_c)   (without a command: xi_enc for xi_c)
    EI = sat(max_i max(|w_i - w_ref,i| / |w_ref,i|, |dw_i/dt| / a_max))
    GI = sat(|W_enc - gyro| / g_th)
    CI = sat((min_i I~_i - I_lo) / (I_hi - I_lo)),       sat(x) = x clipped to 0..1

`reina_deterministic` flags slip where GI >= 1 or CI >= 1. `reina_fuzzy` feeds EI, CI and GI into
Sugeno's inference with fuzzy sets on 0..1 and flags slip where its output is at least 0.5. The
consequents of its rules are trained by least squares: the target is 1 in training windows that
slip, else 0. A window of half a second slips if |xi - xi_enc| > 0.2 |xi_enc|, where xi is the true
twist and yaw rates are multiplied by the base radius.

Two settings are tuned: the time constant of the smoothing, and for `reina_deterministic` the
quantile of steps without slip that sets a_max, g_th and I_hi, for `reina_fuzzy` the number of fuzzy
sets.

Liberties:
- The original only detects slip. Here the path is integrated from the encoders' twist, scaled by
  1 - s where slip is flagged; s is the mean slip of flagged training windows by least squares.
- Thresholds are quantiles over training steps without slip (for I_lo the median); if all windows
  slip, they are the smallest value of the signal.
- Without a gyro, EI >= 1 replaces GI >= 1.
- The original compares the wheels of a rover with each other. An omni robot's wheels turn at
  different speeds, so their speeds are compared with those in proportion to the commanded twist.
  The deviation of a slow wheel is divided by 0.3 of the fastest reference instead of its own. The
  speeds of three omni wheels agree with some twist exactly, whatever they are: EI then measures how
  well wheels follow their command, not whether they slip, and without a command only the
  acceleration term remains.
- The smallest current is taken over wheels that turn with at least 0.3 of the fastest rim speed;
  the load of slower wheels carries no information about slip.
- Fuzzy sets are triangles, every combination of sets has a rule, and consequents are constants
  that are trained on poses; the original's own sets and rules are not used.
- The slip score is the largest unclipped indicator of those that flag slip, or the fuzzy output; it
  is 0 at rest.
- The original also measures the sinkage of its wheels by a camera; that is omitted.

Source: Reina, Ojeda, Milella, Borenstein 2006, "Wheel slippage and sinkage detection for planetary
rovers", IEEE/ASME Transactions on Mechatronics 11(2).
"""

import abc
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, final

import numpy as np
from jaxtyping import Float

from slipid.lab.systems.motion.reina_indicators import (
    LabelledRun,
    SlipThresholds,
    SmoothedSignals,
    Sugeno,
)
from slipid.predict.slip_model import (
    Channel,
    Numbers,
    PredictedRun,
    RobotSpec,
    Run,
    RunSignals,
    SlipModel,
    path_of,
)

_CURRENT: frozenset[Channel] = frozenset({"current"})


@dataclass(frozen=True)
class _Detector(SlipModel):
    """Base class of both slip detectors.

    Attributes:
        smoothing: time constant of the smoothing [s].
        quantile: quantile of signals in steps without slip that sets the thresholds.
        limits: fitted thresholds.
        slip: fitted fraction of the encoders' twist that is subtracted where slip is flagged.
    """

    threshold: ClassVar[float]
    """Smallest score at which slip is flagged."""
    needs: frozenset[Channel] = field(default=_CURRENT, kw_only=True)
    smoothing: float = 0.3
    quantile: float = 0.95
    limits: SlipThresholds = field(default_factory=SlipThresholds)
    slip: float = 0.0

    def fit(self, runs: Sequence[Run], spec: RobotSpec) -> "_Detector":
        examples = [LabelledRun.of(run, spec, self.smoothing) for run in runs]
        limited = replace(self, limits=SlipThresholds.of(examples, self.quantile))
        trained = limited._trained(examples)
        return replace(trained, slip=trained._mean_slip(examples))

    def predict(self, runs: Sequence[RunSignals], spec: RobotSpec) -> list[PredictedRun]:
        predicted = []
        for run in runs:
            score = self.score(SmoothedSignals.of(run, spec, self.smoothing))
            kept = 1.0 - self.slip * (score >= self.threshold)
            path = path_of(run.rolling(spec) * kept[:, None], run.dt)
            predicted.append(PredictedRun(path, slipping=score))
        return predicted

    def score(self, signals: SmoothedSignals) -> Numbers:
        """Return the slip score of each step; 0 at rest."""
        score = self._moving_score(*self.limits.indicators(signals))
        return np.where(signals.moving, score, 0.0)

    def _mean_slip(self, examples: Sequence[LabelledRun]) -> float:
        """Return the mean slip of flagged steps, by least squares in the twists of windows."""
        shares = []
        for example in examples:
            flags = (self.score(example.signals) >= self.threshold).astype(float)
            count = np.diff(example.first, append=len(flags))
            shares.append(np.add.reduceat(flags, example.first) / count)
        share = np.concatenate(shares)
        square = share**2 @ np.concatenate([example.square for example in examples])
        against = share @ np.concatenate([example.against for example in examples])
        return float(against / square) if square > 0.0 else 0.0

    def _trained(self, examples: Sequence[LabelledRun]) -> "_Detector":
        """Return the detector with its remaining parameters trained; thresholds are set already."""
        return self

    @abc.abstractmethod
    def _moving_score(self, encoder: Numbers, current: Numbers, gyro: Numbers | None) -> Numbers:
        """Return the slip score from the indicators EI, CI and GI of a robot that moves."""


@final
@dataclass(frozen=True)
class ReinaDeterministic(_Detector):
    """Detector that flags slip where GI >= 1 or CI >= 1; EI replaces GI without a gyro."""

    threshold: ClassVar[float] = 1.0
    name: str = "reina_deterministic"

    def candidates(self) -> Sequence["ReinaDeterministic"]:
        return [replace(self, quantile=q, smoothing=s) for q in (0.9, 0.98) for s in (0.3, 1.0)]

    @property
    def numbers(self) -> int:
        return 4 + int(np.isfinite(self.limits.turning))

    def _moving_score(self, encoder: Numbers, current: Numbers, gyro: Numbers | None) -> Numbers:
        return np.maximum(encoder if gyro is None else gyro, current)


@final
@dataclass(frozen=True)
class ReinaFuzzy(_Detector):
    """Detector that flags slip where Sugeno's inference from EI, CI and GI is at least one half.

    Attributes:
        sets: number of fuzzy sets of every indicator.
        rules: fitted rules.
    """

    threshold: ClassVar[float] = 0.5
    name: str = "reina_fuzzy"
    sets: int = 2
    rules: Sugeno | None = None

    def candidates(self) -> Sequence["ReinaFuzzy"]:
        return [replace(self, sets=n, smoothing=s) for n in (2, 3) for s in (0.3, 1.0)]

    @property
    def numbers(self) -> int:
        rules = 0 if self.rules is None else len(self.rules.consequents)
        return 4 + int(np.isfinite(self.limits.turning)) + rules

    def _trained(self, examples: Sequence[LabelledRun]) -> "ReinaFuzzy":
        indicators = [self.limits.indicators(example.signals) for example in examples]
        inputs = np.concatenate([self._inputs(*of_run) for of_run in indicators])
        slips = np.concatenate([example.slips for example in examples])
        known = np.isfinite(slips)
        untrained = Sugeno.logical_or(inputs.shape[1], self.sets)
        return replace(self, rules=untrained.trained(inputs[known], slips[known]))

    def _moving_score(self, encoder: Numbers, current: Numbers, gyro: Numbers | None) -> Numbers:
        inputs = self._inputs(encoder, current, gyro)
        rules = self.rules or Sugeno.logical_or(inputs.shape[1], self.sets)
        return rules.infer(inputs)

    def _inputs(
        self, encoder: Numbers, current: Numbers, gyro: Numbers | None
    ) -> Float[np.ndarray, "step input"]:
        """Return the indicators as columns; GI is 0 in a run without a gyro."""
        columns = [encoder, current]
        if np.isfinite(self.limits.turning):
            columns.append(np.zeros_like(encoder) if gyro is None else gyro)
        return np.stack(columns, axis=1)
