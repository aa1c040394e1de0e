"""The paper's slip models refitted on its own points: coefficients and error of each form."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slipid.baselines.paper2021.models import CURRENT_SVR, TORQUE_SVR, polynomial
from slipid.baselines.paper2021.samples import (
    FIGURE_2,
    FIGURES_3_AND_4,
    MOTORS,
    SURFACES,
    Recipe,
    Samples,
    pool,
    read_columns,
    require_columns,
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
        return polynomial((0.0,) * self.first_power + self.coefficients, x)


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
    """Least squares of one form of the table.

    Args:
        samples: points of one motor.
        name: one of the table's rows.

    Raises:
        ValueError: if there are fewer samples than coefficients.
    """
    regressor, powers = _FORMS[name]
    x = samples.torque if regressor == "torque" else samples.current
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


def fit_motor(by_surface: dict[str, Samples], stored: bool) -> MotorTable:
    """All forms of one motor, pooled over surfaces.

    Args:
        by_surface: points of one motor per surface.
        stored: judge the paper's stored quadratic beside them.
    """
    samples = pool(list(by_surface.values()))
    forms = {name: fit_form(samples, name) for name in _FORMS}
    kept = _stored("stored quadratic SVR", "torque", TORQUE_SVR, samples) if stored else None
    return MotorTable(samples=samples, by_surface=by_surface, forms=forms, stored=kept)


def surface_tables(folder: Path, recipe: Recipe = FIGURES_3_AND_4) -> dict[int, MotorTable]:
    """The table behind figures 3 and 4, motors 1 to 3, from experimental_data_<surface>.csv.

    Args:
        folder: the 2021 data set.
        recipe: the authors' choices.

    Raises:
        DataError: if a file or a column is missing.
    """
    tables = {}
    for surface in SURFACES:
        path = folder / f"experimental_data_{surface}.csv"
        tables[surface] = read_columns(path, "robotino2021")
        require_columns(tables[surface], recipe, path)
    return {
        motor: fit_motor(
            {surface: slip_samples(table, motor, recipe) for surface, table in tables.items()},
            stored=motor == 1,
        )
        for motor in MOTORS
    }


def field_table(folder: Path, recipe: Recipe = FIGURE_2) -> MotorTable:
    """Figure 2: motor 1 over the whole heterogeneous site, our least squares and the paper's SVR.

    Args:
        folder: the 2021 data set.
        recipe: the authors' choices.

    Raises:
        DataError: if the file or a column is missing.
    """
    path = folder / "experimental_data_on_whole_field.csv"
    table = read_columns(path, "robotino2021_field")
    require_columns(table, recipe, path)
    samples = slip_samples(table, 1, recipe)
    forms = {name: fit_form(samples, name) for name in ("affine in I", "constant")}
    kept = _stored("stored linear SVR", "current", CURRENT_SVR, samples)
    return MotorTable(samples=samples, by_surface={}, forms=forms, stored=kept)


def _stored(
    name: str, regressor: str, coefficients: tuple[float, ...], samples: Samples
) -> FittedForm:
    x = samples.torque if regressor == "torque" else samples.current
    rmse = _rms(samples.slip - polynomial(coefficients, x))
    return FittedForm(name, regressor, coefficients, first_power=0, rmse=rmse)


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(error**2)))
