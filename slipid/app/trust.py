"""Verdict on a fit, by comparison of its open-loop predictions with encoder odometry."""

import numpy as np

from slipid.data.runs import Runs
from slipid.infer.result import Fit
from slipid.infer.verdicts.disputed import EndPoints, Trust, verdict_of_trust
from slipid.predict import open_loop as replay
from slipid.predict.kinematics import Encoder
from slipid.predict.slip_models import FloorModels
from slipid.predict.validation import ScoredRun, add_scores
from slipid.support.errors import DataError

ENCODER = FloorModels(Encoder())
MOST_RUNS = 24
"""Largest number of predicted runs on each floor, which are picked evenly from the fitted runs."""


def trust_report(fit: Fit, data: Runs) -> Trust:
    """Return the verdict on a fit from open-loop predictions of the runs that it was fitted to."""
    some = data.subset(_picked(data))
    runs: dict[int, ScoredRun] = {}
    try:
        cuts = replay.replay_windows(some, fit.robot)
    except DataError:  # the fitted lag may be so large that a short run has no windows
        cuts = []
    for w in cuts:
        plain = replay.tracks_from_increments(fit.robot, w, ENCODER.increments(w, fit.robot))
        for name, tracks in ((fit.contact.name, fit.contact.tracks(w)), (ENCODER.name, plain)):
            add_scores(runs, some, name, tracks, None)
    errors: dict[str, list[list[float]]] = {}
    for run in runs.values():
        off = [score.endpoint_error_over_path for score in run.models.values()]
        errors.setdefault(run.surface, []).append(off)
    floors = {
        name: EndPoints(*np.mean(each, axis=0).tolist()) for name, each in sorted(errors.items())
    }
    return verdict_of_trust(floors, fit.converged, fit.parameters.values(), len(runs))


def _picked(data: Runs) -> list[int]:
    """Return the indices of at most `MOST_RUNS` runs on every floor."""
    of_floor: dict[str, list[int]] = {}
    for k, log in enumerate(data.logs):
        of_floor.setdefault(log.surface or "unknown", []).append(k)
    out = []
    for runs in of_floor.values():
        at = np.unique(np.linspace(0, len(runs) - 1, MOST_RUNS).round().astype(int))
        out += [runs[k] for k in at]
    return sorted(out)
