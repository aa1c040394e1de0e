"""The paper's slip models refitted on its own points: coefficients and error of each form."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slipid.baselines.paper2021.models import CURRENT_SVR, TORQUE_SVR
from slipid.baselines.paper2021.samples import (
    FIGURE_2,
    FIGURES_3_AND_4,
    MOTORS,
    SURFACES,
    Recipe,
    Samples,
    needed,
    pool,
    read_columns,
    slip_samples,
)

# name: (regressor, powers of it in the design matrix)
_FORMS = {
    "linear in M": ("torque", (1,)),
    "affine in M": ("torque", (0, 1)),
    "quadratic in M": ("torque", (0, 1, 2)),
    "affine in I": ("current", (0, 1)),
    "constant": ("current", (0,)),
}


@dataclass(frozen=True)
class FittedForm:
    """One form of slip model with its coefficients, rising in power from `first_power`.

    Args:
        name: what tables call it.
        regressor: "torque" [N m] or "current" [A].
        coefficients: c_k of s = sum c_k x^(first_power + k).
        first_power: 0, or 1 for a line through the origin.
        rmse: root mean square error in slip [-] on the samples given.
    """

    name: str
    regressor: str
    coefficients: tuple[float, ...]
    first_power: int
    rmse: float

    def slip(self, x: np.ndarray) -> np.ndarray:
        """Slip [-] at values of the regressor."""
        return np.polynomial.polynomial.polyval(x, (0.0,) * self.first_power + self.coefficients)


@dataclass(frozen=True, eq=False)
class MotorTable:
    """All forms of one motor, on the same samples, and what the samples are.

    Args:
        samples: the points fitted.
        by_surface: the same points, per surface.
        forms: the least-squares fits, by name.
        stored: the paper's stored model for these samples, not refitted; motor 1 only.
    """

    samples: Samples
    by_surface: dict[str, Samples]
    forms: dict[str, FittedForm]
    stored: FittedForm | None

    @property
    def motor(self) -> int:
        return self.samples.motor


def fit_form(samples: Samples, name: str) -> FittedForm:
    """Least squares of one row of the table.

    Raises:
        ValueError: if there are fewer samples than coefficients.
    """
    regressor, powers = _FORMS[name]
    x = samples.of(regressor)
    if len(x) < len(powers):
        raise ValueError(f"{name}: {len(x)} samples cannot fix {len(powers)} coefficients")
    design = x[:, None] ** np.array(powers)
    coefficients = np.linalg.lstsq(design, samples.slip, rcond=None)[0]
    return FittedForm(
        name=name,
        regressor=regressor,
        coefficients=tuple(float(c) for c in coefficients),
        first_power=powers[0],
        rmse=_rms(samples.slip - design @ coefficients),
    )


def surface_tables(folder: Path, recipe: Recipe = FIGURES_3_AND_4) -> dict[int, MotorTable]:
    """The table behind figures 3 and 4, motors 1 to 3, from experimental_data_<surface>.csv.

    Raises:
        DataError: if a file or a column is missing.
    """
    tables = {}
    for surface in SURFACES:
        path = folder / f"experimental_data_{surface}.csv"
        tables[surface] = read_columns(path, "robotino2021", needed(recipe))
    found = {}
    for motor in MOTORS:
        parts = {name: slip_samples(table, motor, recipe) for name, table in tables.items()}
        samples = pool(list(parts.values()))
        forms = {name: fit_form(samples, name) for name in _FORMS}
        kept = _stored("stored quadratic SVR", "torque", TORQUE_SVR, samples)
        found[motor] = MotorTable(samples, parts, forms, kept if motor == 1 else None)
    return found


def field_table(folder: Path, recipe: Recipe = FIGURE_2) -> MotorTable:
    """Figure 2: motor 1 over the whole heterogeneous site, our least squares and the paper's SVR.

    Raises:
        DataError: if the file or a column is missing.
    """
    path = folder / "experimental_data_on_whole_field.csv"
    table = read_columns(path, "robotino2021_field", needed(recipe))
    samples = slip_samples(table, 1, recipe)
    forms = {name: fit_form(samples, name) for name in ("affine in I", "constant")}
    kept = _stored("stored linear SVR", "current", CURRENT_SVR, samples)
    return MotorTable(samples=samples, by_surface={}, forms=forms, stored=kept)


def _stored(
    name: str, regressor: str, coefficients: tuple[float, ...], samples: Samples
) -> FittedForm:
    form = FittedForm(name, regressor, coefficients, first_power=0, rmse=0.0)
    return replace(form, rmse=_rms(samples.slip - form.slip(samples.of(regressor))))


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(error**2)))
