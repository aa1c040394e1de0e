"""Search for single runs with wrong poses: poses of another run, or constant poses."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from slipid.data.check.findings import Finding
from slipid.data.check.interpretation import Evidence, Interpretation, to_body
from slipid.data.check.joined import (
    ChannelIncrements,
    JoinedRuns,
    StepEdges,
    body_motion,
    rotation,
    usable,
)

LEAST_PATH_M = 0.2
"""A run is judged if the path length by the wheels exceeds this, since its poses must then move
[m]."""
ROUNDING_M = 1e-6
"""Poses with a path shorter than this are constant, except for rounding [m]."""
LEAST_ROWS = 20
"""Runs with fewer rows are not judged."""
ODD_DISAGREEMENT, ODD_RATIO, USUAL_COSINE = 0.3, 10.0, 0.9
"""A run has poses of another run if its disagreement, 1 - cosine, exceeds both `ODD_DISAGREEMENT`
and `ODD_RATIO` times that of the median run. No run is judged if the median run's cosine is below
`USUAL_COSINE`."""
LONGEST_RATIO = 4.0
"""Multiple of the median length of the body increments to which longer increments are
shortened [1]."""
SHARE_IF_ALL = 0.5
"""If at least this fraction of the runs has constant poses, the finding is about all runs [1]."""


@dataclass(frozen=True, eq=False)
class RunAgreement:
    """Agreement of poses with wheels in each run.

    Path lengths include rotation, as an arc at the base radius.

    Attributes:
        wheels_m: path length of the body predicted from the wheels (run,) [m].
        poses_m: path length of the poses (run,) [m].
        cosine: normalised scalar product of the body increments from the poses and from the wheels
            (run,) [1].
        judged: True if the run has enough rows, and its wheels travel far enough, to be judged
            (run,).
    """

    wheels_m: Float[np.ndarray, " run"]
    poses_m: Float[np.ndarray, " run"]
    cosine: Float[np.ndarray, " run"]
    judged: Bool[np.ndarray, " run"]

    @property
    def still(self) -> Bool[np.ndarray, " run"]:
        """Return, for each run, whether its poses are constant although its wheels turn."""
        return self.judged & (self.poses_m < ROUNDING_M)


def agreement(
    data: JoinedRuns,
    at: StepEdges,
    moved: ChannelIncrements,
    evidence: Evidence,
    meant: Interpretation,
) -> RunAgreement:
    """Return the agreement of poses with wheels in every run, under an interpretation."""
    convention = meant.convention
    body = body_motion(at, convention.bare) * [1.0, 1.0, evidence.base]
    body = body @ rotation(-convention.offset).T
    predicted = moved.wheels @ to_body(evidence, meant).T
    known = usable(body, predicted)
    body, predicted, run = body[known], predicted[known], at.run[known]
    length = np.linalg.norm(body, axis=1)
    most = LONGEST_RATIO * float(np.median(length[length > 0])) if (length > 0).any() else 1.0
    body = body * np.minimum(1.0, most / np.maximum(length, 1e-300))[:, None]
    # The prediction is scaled along each axis, because slip shortens the motion by a different
    # factor along each.
    squares = (predicted**2).sum(axis=0)
    factor = (predicted * body).sum(axis=0) / np.where(squares > 0, squares, 1.0)
    scaled = predicted * np.where(factor > 0, factor, 0.0)

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(run, values, minlength=len(data.names))

    size = np.sqrt(total((body**2).sum(axis=1)) * total((scaled**2).sum(axis=1)))
    both = total((body * scaled).sum(axis=1))
    wheels_m = total(np.linalg.norm(predicted, axis=1))
    rows = (data.end - data.begin) / data.row
    return RunAgreement(
        wheels_m,
        total(np.linalg.norm(body, axis=1)),
        np.where(size > 0, both / np.where(size > 0, size, 1.0), 0.0),
        (rows >= LEAST_ROWS) & (wheels_m > LEAST_PATH_M),
    )


def single_runs(data: JoinedRuns, compared: RunAgreement) -> Iterator[Finding]:
    """Yield findings about runs with constant poses, and about runs with poses of another run."""
    still = compared.still
    if still.any():
        every = bool(still.mean() >= SHARE_IF_ALL)
        yield Finding(
            "pose_constant",
            f"the poses do not change in {still.sum()} of {len(still)} runs while the wheels "
            f"travel {np.median(compared.wheels_m[still]):.2g} m",
            "check the columns of pose_x, pose_y and pose_heading, and the marker's visibility"
            if every
            else "exclude these runs from the globs of [[logs]]",
            runs=() if every else _names(data, still),
        )
    # Runs in which the robot slips in place disagree for a good reason, and are not judged.
    moves = compared.judged & ~still
    if moves.any():
        share = compared.poses_m / np.maximum(compared.wheels_m, 1e-300)
        moves &= share > 0.25 * np.median(share[moves])
    if moves.sum() < 2 or (usual := float(np.median(compared.cosine[moves]))) < USUAL_COSINE:
        return
    odd = moves & (1 - compared.cosine > max(ODD_DISAGREEMENT, ODD_RATIO * (1 - usual)))
    if odd.any():
        yield Finding(
            "pose_of_another_run",
            f"the poses of {odd.sum()} of {len(odd)} runs do not follow their wheels "
            f"(agreement {np.median(compared.cosine[odd]):.2f}, in the other runs "
            f"{np.median(compared.cosine[moves & ~odd]):.2f})",
            "check whether these files contain poses of another run or of another time; if so, "
            "exclude them from the globs of [[logs]]",
            runs=_names(data, odd),
        )


def _names(data: JoinedRuns, which: Bool[np.ndarray, " run"]) -> tuple[str, ...]:
    return tuple(data.names[k] for k in np.flatnonzero(which))
