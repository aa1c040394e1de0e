"""The paper's slip models: as published, as deployed, and each form refitted to its samples."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slipid.lab.paper2021.samples import (
    FIGURE_2,
    FIGURES_3_AND_4,
    MOTORS,
    SURFACES,
    SlipSamples,
    needed,
    pool,
    read_columns,
    slip_samples,
)

CURRENT_SVR = (0.120, 0.566)
"""Coefficients of the line of figure 2, s = 0.120 + 0.566 I, with I in A.

The authors fitted it to motor 1 over the whole field by epsilon-SVR with a linear kernel.
"""

TORQUE_SVR = (-0.072, 4.888, -5.456)
"""Coefficients of the curve of figure 4, s = -0.072 + 4.888 M - 5.456 M^2, with M in N m.

The authors fitted it to motor 1 by a quadratic SVR; M is at the motor shaft.
"""

DEPLOYED_GAIN, DEPLOYED_OFFSET = (-0.639, -0.4559, -0.6294), (0.988, 0.9678, 0.9913)
"""Coefficients a [1/A] and b [-] of `deployed_slip` for motors 1, 2, 3."""
DEPLOYED_THRESHOLD = 0.4
"""Largest smoothed current at which a wheel counts as not slipping [A]."""
DEPLOYED_MEMORY = 0.97
"""Weight of the previous smoothed current in the next one [-]."""

# keyed by name of the form: the regressor, and its exponents in the columns of the design matrix
_FORMS = {
    "linear in M": ("torque", (1,)),
    "affine in M": ("torque", (0, 1)),
    "quadratic in M": ("torque", (0, 1, 2)),
    "affine in I": ("current", (0, 1)),
    "constant": ("current", (0,)),
}


def deployed_slip(current: np.ndarray) -> np.ndarray:
    """Return the slip [-] of each wheel from its smoothed current [A], both (sample, wheel).

    1 - s_i = a_i I~_i + b_i where the smoothed current I~_i > threshold, else s_i = 0. The paper's
    robot smoothed the current from sample to sample, I~_k = memory I~_(k-1) + (1 - memory) I_k. The
    authors' lines leave the range [0, 1] above 1.55 A. Here 1 - s is clipped to this range, so that
    no wheel counts as rolling backwards.

    Source: Belyaev et al. 2021, section 3, coefficients as deployed.
    """
    grip = np.clip(np.array(DEPLOYED_GAIN) * current + DEPLOYED_OFFSET, 0.0, 1.0)
    return np.where(current > DEPLOYED_THRESHOLD, 1.0 - grip, 0.0)


@dataclass(frozen=True)
class FittedForm:
    """Polynomial model of slip, s = sum_k c_k x^(first_power + k).

    Attributes:
        regressor: quantity x: "torque" [N m] or "current" [A].
        coefficients: coefficients c_k.
        first_power: 0, or 1 for a line through the origin.
        rmse: root mean square error in slip [-] on the samples of its table.
    """

    regressor: str
    coefficients: tuple[float, ...]
    first_power: int
    rmse: float

    def slip(self, x: np.ndarray) -> np.ndarray:
        """Return slip [-] at values of the regressor."""
        return np.polynomial.polynomial.polyval(x, (0.0,) * self.first_power + self.coefficients)


@dataclass(frozen=True, eq=False)
class MotorTable:
    """Slip models of one motor on the same samples.

    Attributes:
        samples: samples to which the models are fitted.
        by_surface: the same samples by surface; empty for the whole field.
        forms: least-squares fits keyed by name of the form.
        stored: model with the paper's own coefficients for motor 1, not refitted; None for other
            motors.
    """

    samples: SlipSamples
    by_surface: dict[str, SlipSamples]
    forms: dict[str, FittedForm]
    stored: FittedForm | None


def fit_form(samples: SlipSamples, name: str) -> FittedForm:
    """Return the least-squares fit of a form to the samples; `name` is a key of `_FORMS`.

    Raises:
        ValueError: there are fewer samples than coefficients.
    """
    regressor, powers = _FORMS[name]
    x = getattr(samples, regressor)
    if len(x) < len(powers):
        raise ValueError(
            f"{name}: {len(x)} samples; expected at least {len(powers)}, one per coefficient"
        )
    design = x[:, None] ** np.array(powers)
    coefficients = np.linalg.lstsq(design, samples.slip, rcond=None)[0]
    return FittedForm(
        regressor=regressor,
        coefficients=tuple(float(c) for c in coefficients),
        first_power=powers[0],
        rmse=_rms(samples.slip - design @ coefficients),
    )


def surface_tables(folder: Path) -> dict[int, MotorTable]:
    """Return the tables of figures 3 and 4 by motor, from experimental_data_<surface>.csv."""
    recipe, tables = FIGURES_3_AND_4, {}
    for surface in SURFACES:
        path = folder / f"experimental_data_{surface}.csv"
        tables[surface] = read_columns(path, "robotino2021", needed(recipe))
    found = {}
    for motor in MOTORS:
        parts = {name: slip_samples(table, motor, recipe) for name, table in tables.items()}
        samples = pool(list(parts.values()))
        forms = {name: fit_form(samples, name) for name in _FORMS}
        kept = _stored("torque", TORQUE_SVR, samples)
        found[motor] = MotorTable(samples, parts, forms, kept if motor == 1 else None)
    return found


def field_table(folder: Path) -> MotorTable:
    """Return the table of figure 2: motor 1 over the whole site, with refitted and stored model."""
    path = folder / "experimental_data_on_whole_field.csv"
    table = read_columns(path, "robotino2021_field", needed(FIGURE_2))
    samples = slip_samples(table, 1, FIGURE_2)
    forms = {name: fit_form(samples, name) for name in ("affine in I", "constant")}
    kept = _stored("current", CURRENT_SVR, samples)
    return MotorTable(samples=samples, by_surface={}, forms=forms, stored=kept)


def _stored(regressor: str, coefficients: tuple[float, ...], samples: SlipSamples) -> FittedForm:
    form = FittedForm(regressor, coefficients, first_power=0, rmse=0.0)
    return replace(form, rmse=_rms(samples.slip - form.slip(getattr(samples, regressor))))


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(error**2)))
