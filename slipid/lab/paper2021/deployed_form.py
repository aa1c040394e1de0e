"""The 2021 paper's system: the slip of each wheel from the torque or current of its motor.

    xi = back r (w_i (1 - s_i))

    paper_print           s = -0.072 + 4.888 M - 5.456 M^2, clipped to [0, 1], as printed
    paper_code            1 - s = a_i I~ + b_i, s in [0, 1], where I~ > 0.4 A, else s = 0, as run
                          on the authors' robot
    paper_print_refit     s = c0 + c1 M + c2 M^2, one curve for all motors
    paper_code_refit      s = c_i I~ + d_i where I~ > 0.4 A, else s = 0, for each motor
    paper_linear_svr      s = c0 + c1 M, by epsilon-insensitive regression, clipped to [0, 1]
    paper_quadratic_svr   s = c0 + c1 M + c2 M^2, likewise

xi is the twist of the body, `back` the matrix from wheel rim speeds to the twist, r the wheel
radius [m], w_i the speed [rad/s] and s_i the slip of wheel i. M is the torque characterising
variable at the motor's shaft [N m], I~ the current [A] after exponential smoothing, which keeps
0.97 of its value from one sample of 31 ms to the next. The first two rows have the authors' own
coefficients and are never fitted. The refits minimise squared errors of displacement in half-second
windows. The last two rows follow the authors' recipe: s = 1 - w_eff / w of each wheel and window,
with w_eff from the pose; only samples with 0 < s <= 1 and I > 0.25 A are kept, which truncates the
response that is fitted.

Tuned: C and epsilon of the support vector regressions.

Liberties:
    - M is regular at rest (`RunSignals.torque`); the authors divide by the shaft's speed.
      `paper_print` uses the winding resistance R and back-EMF constant C_e of the authors'
      scripts, the refits those of the robot's config.
    - `paper_code` starts its smoothing at a run's first current. On robots that do not have three
      drives, each wheel has the mean of the slips by the three motors' lines.
    - The refits are clipped to [-1, 1] instead of [0, 1]: the slip of a dragged wheel is negative.
    - The recipe's M is not cut at 0.5 N m, and all motors are pooled, as the printed curve is used
      for all; at most 3000 samples are used.
    - C and epsilon are not printed. With our values, epsilon a tenth of a robust std, the line of
      figure 2 is reproduced from the authors' samples (0.115 + 0.570 I for 0.120 + 0.566 I); the
      curve of figure 4 is not reproduced from what they published.
    - The quadratic regression is linear in M and M^2, standardised. The authors may have used a
      polynomial kernel, which gives the same curves under another penalty.

Source: Belyaev, Brylev, Ivanov 2021, IFAC-PapersOnLine 54(13), section 3, figures 2 to 4, and the
code that its authors published, BrOleg5/Slippage-compensation.
"""

import abc
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self, final

import numpy as np
from jaxtyping import Float

from slipid.lab.paper2021 import table as tables
from slipid.lab.paper2021.samples import FIGURES_3_AND_4, SlipSamples
from slipid.predict.curves import CurveModel, Slips, WheelSlip, above, powers, robust_std
from slipid.predict.slip_model import Channel, RobotSpec, RunSignals, SlipModel
from slipid.predict.steps import Steps, TrainingWindows

NEEDS: frozenset[Channel] = frozenset({"current", "twist"})
TIME_CONSTANT = -0.031 / float(np.log(tables.DEPLOYED_MEMORY))
"""Time constant of the authors' smoothing [s]: their computer sampled about every 31 ms."""
MOST_SAMPLES = 3000
"""Largest number of samples of a support vector regression."""


@dataclass(frozen=True)
class _AsPublished(WheelSlip, abc.ABC):
    """A slip model with the authors' own coefficients, which is never fitted."""

    learns: ClassVar[bool] = False
    needs: frozenset[Channel] = field(default=NEEDS, kw_only=True)

    def learn(self, w: TrainingWindows, spec: RobotSpec) -> Self:
        return self


@final
@dataclass(frozen=True)
class PaperPrint(_AsPublished):
    """The printed curve of slip over torque, with the motor constants of the authors' scripts."""

    name: str = "paper_print"

    def slip(self, steps: Steps, spec: RobotSpec) -> Slips:
        recipe = FIGURES_3_AND_4
        motor = replace(spec, resistance=recipe.resistance, back_emf=recipe.back_emf)
        torque = steps.signals.torque(motor)
        return np.clip(np.polynomial.polynomial.polyval(torque, tables.TORQUE_SVR), 0.0, 1.0)


@final
@dataclass(frozen=True)
class PaperCode(_AsPublished):
    """The lines of slip over smoothed current, one per motor, that ran on the authors' robot."""

    name: str = "paper_code"

    def slip(self, steps: Steps, spec: RobotSpec) -> Slips:
        current = steps.smoothed(steps.signals.along(spec), TIME_CONSTANT)
        if current.shape[1] == 3:
            return tables.deployed_slip(current)
        of_each = tables.deployed_slip(np.repeat(current.reshape(-1, 1), 3, axis=1))
        return np.asarray(of_each.mean(axis=1).reshape(current.shape))


def recipe_samples(w: TrainingWindows, spec: RobotSpec) -> SlipSamples:
    """Return samples of single wheels and windows within the authors' limits of slip and current.

    If there are more than `MOST_SAMPLES`, this number is drawn at random.
    """
    signals = w.signals
    rim = signals.speed * spec.wheel_radius
    real = w.twist @ spec.forward.T
    with np.errstate(divide="ignore", invalid="ignore"):
        # a wheel at rest has no finite slip ratio, so that the comparisons below omit its sample
        slip = 1.0 - real / rim
    amps = signals.along(spec)
    kept = (slip > 0.0) & (slip <= 1.0) & (amps > FIGURES_3_AND_4.min_current)
    drawn = np.random.default_rng(0).permutation(int(kept.sum()))[:MOST_SAMPLES]
    return SlipSamples(*(x[kept][drawn] for x in (amps, signals.torque(spec), slip)))


def insensitive_curve(
    x: Float[np.ndarray, " sample"],
    slip: Float[np.ndarray, " sample"],
    degree: int,
    c: float,
    tube: float,
) -> Float[np.ndarray, " power"]:
    """Return coefficients of 1, x, ..., x^degree by epsilon-insensitive regression.

    The support vector regression is linear in standardised powers of x, with a centred slip; its
    penalty applies to the coefficients of the standardised powers. C weights the loss of each
    sample; epsilon is `tube` times a robust std of the slip.
    """
    from sklearn.svm import LinearSVR

    powers = x[:, None] ** np.arange(1, degree + 1)
    middle, size = powers.mean(axis=0), powers.std(axis=0)
    regression = LinearSVR(C=c, epsilon=tube * robust_std(slip), random_state=0, max_iter=20_000)
    found = regression.fit((powers - middle) / size, slip - slip.mean())
    gain = found.coef_ / size
    return np.append(slip.mean() + found.intercept_[0] - gain @ middle, gain)


@final
@dataclass(frozen=True)
class PaperSvr(WheelSlip):
    """Support vector regression of slip over torque, by the authors' recipe.

    The coefficients are those of 1, M and, for degree 2, M^2.

    Attributes:
        degree: degree of the polynomial, 1 or 2.
        c: weight of each sample's loss outside the tube.
        tube: half width epsilon of the tube without loss, in robust stds of the slip.
    """

    needs: frozenset[Channel] = field(default=NEEDS, kw_only=True)
    degree: int = 1
    c: float = 0.1
    tube: float = 0.1

    def candidates(self) -> Sequence["PaperSvr"]:
        return [replace(self, c=c, tube=tube) for c in (1e-3, 0.1) for tube in (0.1, 0.5)]

    def learn(self, w: TrainingWindows, spec: RobotSpec) -> "PaperSvr":
        samples = recipe_samples(w, spec)
        if len(np.unique(samples.torque.round(9))) <= self.degree:
            # with too few samples for a curve, the slip is their mean, or 0 without samples
            level = float(samples.slip.mean()) if len(samples) else 0.0
            return replace(self, coefficients=np.array([level] + [0.0] * self.degree))
        curve = insensitive_curve(samples.torque, samples.slip, self.degree, self.c, self.tube)
        return replace(self, coefficients=curve)

    def slip(self, steps: Steps, spec: RobotSpec) -> Slips:
        torque = steps.signals.torque(spec)
        return np.clip(np.polynomial.polynomial.polyval(torque, self.known), 0.0, 1.0)


def refits() -> list[CurveModel]:
    """Return unfitted curves of the printed and of the deployed form, clipped to [-1, 1]."""
    deployed = above(tables.DEPLOYED_THRESHOLD)
    return [
        CurveModel("paper_print_refit", powers(0, 1, 2), RunSignals.torque, most=1.0, needs=NEEDS),
        CurveModel(
            "paper_code_refit",
            deployed,
            per_wheel=True,
            smoothing=TIME_CONSTANT,
            most=1.0,
            needs=NEEDS,
        ),
    ]


def paper_rows() -> list[SlipModel]:
    """Return the unfitted models of the paper's rows in the benchmark."""
    svr = PaperSvr("paper_linear_svr", 1), PaperSvr("paper_quadratic_svr", 2)
    return [PaperPrint(), PaperCode(), *refits(), *svr]
