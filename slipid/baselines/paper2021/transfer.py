"""Does one curve of slip over current carry over to a surface unseen? The 2022 runs tell."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from slipid.baselines.paper2021.windows import WindowRecipe, wheel_windows
from slipid.data.log import Log


@dataclass(frozen=True)
class Transfer:
    """Error in slip [-] on each surface, from three sources of a prediction.

    Args:
        samples: number of them per surface.
        pooled: root mean square error of a curve fitted to the other surfaces.
        constant: error of the other surfaces' mean slip.
        own: error of a curve fitted to the surface itself.
    """

    samples: dict[str, int]
    pooled: dict[str, float]
    constant: dict[str, float]
    own: dict[str, float]

    def mean(self) -> dict[str, float]:
        """Each error averaged over surfaces, every surface counting the same."""
        rows = {"pooled": self.pooled, "constant": self.constant, "own": self.own}
        return {name: float(np.mean(list(row.values()))) for name, row in rows.items()}


def curve_points(log: Log, recipe: WindowRecipe, min_current: float = 0.25) -> np.ndarray:
    """Current [A] and slip [-] of all wheels after the paper's cuts, shape (sample, 2)."""
    current, slip = wheel_windows(log, recipe)
    keep = (slip > 0.0) & (slip <= 1.0) & (current > min_current)
    return np.stack([current[keep], slip[keep]], axis=1)


def leave_one_surface_out(
    logs: Iterable[Log], recipe: WindowRecipe | None = None, degree: int = 1
) -> Transfer:
    """Predict the slip of each surface from the others' curve, their mean, and its own curve.

    Args:
        logs: runs on one known surface each.
        recipe: how runs are cut into windows; half a second, camera uncorrected, where None.
        degree: degree of the polynomial in current, 1 as deployed.

    Raises:
        ValueError: if fewer than two surfaces are there, or one has too few samples for a curve.
    """
    recipe = recipe or WindowRecipe()
    parts: dict[str, list[np.ndarray]] = {}
    for log in logs:
        if log.surface is None:
            raise ValueError(f"{log.name}: no known surface; expected runs on one surface each")
        parts.setdefault(log.surface, []).append(curve_points(log, recipe))
    points = {surface: np.concatenate(part) for surface, part in parts.items()}
    if len(points) < 2:
        raise ValueError(f"surfaces {list(points)}: leaving one out needs at least two")
    for surface, point in points.items():
        if len(point) <= degree:
            raise ValueError(f"surface {surface!r}: {len(point)} samples, too few for a curve")
    pooled, constant, own = {}, {}, {}
    for surface, here in points.items():
        others = np.concatenate([p for name, p in points.items() if name != surface])
        pooled[surface] = _curve_error(others, here, degree)
        constant[surface] = _curve_error(others, here, 0)
        own[surface] = _curve_error(here, here, degree)
    counts = {surface: len(point) for surface, point in points.items()}
    return Transfer(samples=counts, pooled=pooled, constant=constant, own=own)


def _curve_error(train: np.ndarray, test: np.ndarray, degree: int) -> float:
    curve = np.polynomial.Polynomial.fit(train[:, 0], train[:, 1], degree)
    return float(np.sqrt(np.mean((test[:, 1] - curve(test[:, 0])) ** 2)))
