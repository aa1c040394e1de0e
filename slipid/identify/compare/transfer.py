"""Does slip against current carry over to a floor it was not fitted on?

One curve s = b0 + b1 |I| for all wheels, fitted to all floors but one and judged on that one,
beside a constant fitted to the same floors and a curve fitted to the floor itself.
"""

import numpy as np

from slipid.data.windows import Windows
from slipid.identify.compare.marker import body_twist
from slipid.identify.compare.score import main_load
from slipid.model.robot import Robot
from slipid.support.content import Content

LEAST = 0.2
"""A wheel counts in a window where it turns at least this part of the fastest one."""
VARIANTS: dict[str, tuple[float, bool, bool]] = {
    "all": (LEAST, False, False),
    "slower wheels too": (0.1, False, False),
    "fast wheels only": (0.5, False, False),
    "as built only": (LEAST, True, False),
    "0 < s <= 1, I > 0.25 A only": (LEAST, False, True),
}
"""What may be chosen otherwise: least speed of a wheel, one load set-up, the 2021 paper's filter
(which cuts the response off and so flatters what it leaves)."""


def transfer(w: Windows, robot: Robot) -> dict[str, Content]:
    """Leave-one-surface-out errors of slip, per variant of what counts as a row; none of one floor.

    Root mean squares over all `rows`, mean of `floors`, and of `each`, of what is left of slip by
    the curve of the other floors (`pooled`), by their mean slip (`constant`), and by the floor's
    own curve (`per_surface`); `count` is of rows.

    A row is one wheel in one window: s = 1 - J xi / (r w), xi the body twist from the camera in
    corrected metres, I the mean magnitude of the wheel's current.
    """
    if len(set(w.surface)) < 2:
        return {}
    w = w.at_lag(float(robot.camera.lag))
    forward = np.asarray(robot.geometry.forward()) / float(robot.geometry.wheel_radius)
    speed = w.turn / w.dt[..., None]
    slip = 1 - (body_twist(w, robot) @ forward.T) / np.where(speed == 0.0, np.nan, speed)
    share = np.abs(speed) / np.abs(speed).max(axis=-1, keepdims=True)
    amps = np.abs(w.current)
    floor = np.broadcast_to(np.asarray(w.surface)[:, None, None], slip.shape)
    load = np.broadcast_to(np.asarray(w.load)[:, None, None], slip.shape)
    main = main_load(w.load)
    out = {}
    for name, (least, one_load, cut) in VARIANTS.items():
        rows = (share >= least) & np.isfinite(slip) & ((load == main) | (not one_load))
        if cut:
            rows &= (slip > 0) & (slip <= 1) & (amps > 0.25)
        if len(set(floor[rows].tolist())) > 1:
            out[name] = errors_by_floor(slip[rows], amps[rows], floor[rows])
    return out


def errors_by_floor(slip: np.ndarray, amps: np.ndarray, floor: np.ndarray) -> Content:
    """Errors of rows of slip and current [A] on floors by name, see `transfer`."""
    pooled, constant, own = {}, {}, {}
    line = np.stack([np.ones_like(amps), amps], axis=-1)
    for name in sorted(set(floor.tolist())):
        mine = floor == name
        others = np.linalg.lstsq(line[~mine], slip[~mine], rcond=None)[0]
        alone = np.linalg.lstsq(line[mine], slip[mine], rcond=None)[0]
        pooled[name] = slip[mine] - line[mine] @ others
        constant[name] = slip[mine] - slip[~mine].mean()
        own[name] = slip[mine] - line[mine] @ alone
    gaps = {"pooled": pooled, "constant": constant, "per_surface": own}
    return {name: _left(gap) for name, gap in gaps.items()} | {"count": len(slip)}


def _left(gaps: dict[str, np.ndarray]) -> Content:
    each = {name: float(np.sqrt(np.mean(gap**2))) for name, gap in gaps.items()}
    rows = float(np.sqrt(np.mean(np.concatenate(list(gaps.values())) ** 2)))
    return {"rows": rows, "floors": float(np.mean(list(each.values()))), "each": each}
