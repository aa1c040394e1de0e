"""How far a fit may be trusted: its open-loop predictions against those of the encoders."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np

from slipid.data.runs import Runs
from slipid.identify.compare import open_loop as replay
from slipid.identify.compare.slip_models import Encoder
from slipid.identify.result import Fit
from slipid.identify.verdicts.trust import EndPoints, Trust, verdict_of_trust
from slipid.support.content import Content
from slipid.support.errors import DataError

MOST_RUNS = 24
"""Runs that are replayed of every floor, evenly picked from those that were fitted."""


@dataclass(frozen=True)
class Judgement:
    """A verdict and the errors it rests on.

    Attributes:
        trust: the verdict, with its reasons.
        floors: mean end-point error over the way, of the fit and of the encoders alone.
        runs: how many were replayed.
    """

    trust: Trust
    floors: Mapping[str, EndPoints]
    runs: int

    @property
    def warning(self) -> str | None:
        """What a picture must say of a fit that is not to be used."""
        return f"THIS FIT IS {self.trust.word.upper()}" if self.is_bad else None

    @property
    def is_bad(self) -> bool:
        """Whether the fit is not to be trusted at all."""
        return self.trust.word == "not to be trusted"

    def to_json(self) -> Content:
        return {
            "verdict": self.trust.word,
            "reasons": list(self.trust.reasons),
            "runs": self.runs,
            "endpoint_error_over_path": {name: asdict(e) for name, e in self.floors.items()},
        }


def judgement(fit: Fit, data: Runs) -> Judgement:
    """Verdict on a fit by the runs it was made of, replayed from their first pose on."""
    some = data.subset(_picked(data))
    errors: dict[str, list[tuple[float, float]]] = {}
    try:
        cuts = replay.cuts(some, fit.robot)
    except DataError:  # a fitted lag can be so long that a short run shows nothing
        cuts = []
    seen: set[int] = set()
    for w in cuts:
        tracks = fit.contact.tracks(w)
        plain = replay.follow(fit.robot, w, Encoder().increments(w, fit.robot))
        for k, run in enumerate(tracks.run.tolist()):
            if run in seen:
                continue
            seen.add(run)
            way = max(float(tracks.path[k]), 1e-9)
            off = [float(np.hypot(*one.gap[k, :2])) / way for one in (tracks, plain)]
            errors.setdefault(w.surface[k], []).append((off[0], off[1]))
    floors = {
        name: EndPoints(*np.mean(each, axis=0).tolist()) for name, each in sorted(errors.items())
    }
    trust = verdict_of_trust(floors, fit.converged, fit.parameters.values())
    return Judgement(trust, floors, len(seen))


def _picked(data: Runs) -> list[int]:
    """Numbers of at most `MOST_RUNS` runs of every floor."""
    of_floor: dict[str, list[int]] = {}
    for k, log in enumerate(data.logs):
        of_floor.setdefault(log.surface or "unknown", []).append(k)
    out = []
    for runs in of_floor.values():
        at = np.unique(np.linspace(0, len(runs) - 1, MOST_RUNS).round().astype(int))
        out += [runs[k] for k in at]
    return sorted(out)
