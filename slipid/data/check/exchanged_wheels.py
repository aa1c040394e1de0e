"""Search for single runs in which the columns of two wheels are exchanged.

A log that another program or cable made may differ from all others. In such a run most of the
poses' motion is explained only with two columns exchanged; exchanges that change nothing, such as
those of two wheels on one side or in runs straight ahead, are not found.
"""

from dataclasses import replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool

from slipid.data.check.findings import Finding
from slipid.data.check.interpretation import Evidence, Interpretation, misfits
from slipid.data.check.joined import (
    ChannelIncrements,
    PoseConvention,
    StepEdges,
    aligned,
    body_motion,
    products,
)
from slipid.model.geometry import Geometry

LEAST_REDUCTION = 0.12
"""Least reduction by an exchange of the unexplained fraction of the motion of a run [1]. It is at
most 0.07 in correct real runs, and at least 0.16 with exchanged wheels where the robot turns."""
CLEARLY_BETTER_RATIO = 0.25
"""An exchange is found if it leaves less than this multiple of the unexplained fraction [1]; runs
whose poses do not belong to the wheels at all are not explained by any exchange."""


def exchanged_wheels(
    names: tuple[str, ...],
    at: StepEdges,
    moved: ChannelIncrements,
    evidence: Evidence,
    geometry: Geometry,
) -> tuple[Finding, Bool[np.ndarray, " run"]] | None:
    """Return the finding about runs with exchanged columns, and these runs; None without any.

    Args:
        names: names of the runs.
        at: steps of the runs.
        moved: increments of the robot's channels over the steps.
        evidence: evidence from all runs, in which order, signs and axes are as declared.
        geometry: declared geometry of the robot.
    """
    body = aligned(body_motion(at, PoseConvention()), moved.wheels, geometry)
    before, after = np.zeros(len(names)), np.zeros(len(names))
    pairs = [(0, 0)] * len(names)
    for run in range(len(names)):
        mine = at.run == run
        sums = products(moved.wheels[mine], body[mine], evidence.base)
        if sums is None:
            continue
        alone = replace(evidence, pose={PoseConvention(): sums}, twist=None, command=None)
        before[run] = misfits(alone, Interpretation())["pose"]
        tried = {
            (a, b): misfits(alone, Interpretation(order=_exchange(evidence.wheels, a, b)))["pose"]
            for a, b in combinations(range(evidence.wheels), 2)
        }
        pairs[run] = min(tried, key=lambda pair: tried[pair], default=(0, 0))
        after[run] = tried.get(pairs[run], before[run])
    which = (before - after > LEAST_REDUCTION) & (after < CLEARLY_BETTER_RATIO * before)
    if not which.any():
        return None
    worst = int(np.argmax(np.where(which, before - after, -1.0)))
    a, b = pairs[worst]
    found = Finding(
        "wheels_exchanged",
        f"the poses of {which.sum()} of {len(which)} runs follow their wheels only with two "
        f"columns exchanged: in the clearest run {after[worst]:.2f} of the motion remains "
        f"unexplained with wheels {a + 1} and {b + 1} exchanged, and {before[worst]:.2f} as "
        "declared",
        "exchange the columns of these runs (or x and y of their poses, if those are exchanged "
        "instead) in a layout of their own, or exclude the runs from the globs of [[logs]]",
        runs=tuple(names[k] for k in np.flatnonzero(which)),
    )
    return found, which


def _exchange(wheels: int, a: int, b: int) -> tuple[int, ...]:
    """Return the declared order of the wheels with two of them exchanged."""
    order = list(range(wheels))
    order[a], order[b] = b, a
    return tuple(order)
