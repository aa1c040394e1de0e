"""What runs at one speed cannot tell, and is held for them."""

from collections.abc import Iterable
from glob import escape

import numpy as np

from slipid.data.runs import Runs
from slipid.search_space import Choice


def still_viscosities(data: Runs, runs: Iterable[int] | np.ndarray | None = None) -> list[Choice]:
    """Viscous terms held near zero on every floor that was driven at one speed only.

    With one speed they cannot be told from creep, and what they take from it is wrong at every
    other speed.
    """
    seen: dict[str, list[float]] = {}
    for k in range(len(data)) if runs is None else runs:
        seen.setdefault(data.logs[k].surface or "unknown", []).append(float(data.speed[k]))
    out = []
    for floor, speeds in seen.items():
        known = np.asarray(speeds)[np.isfinite(speeds)]
        if len(known) == len(speeds) and known.max() < 1.3 * max(known.min(), 1e-3):
            names = (f"surface.{floor}.{name}" for name in ("slide_viscosity", "roller_viscosity"))
            out += [Choice(escape(path), fixed=1e-4) for path in names]
    return out
