"""Draws of a posterior; to hold them needs nothing that sampling needs."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.identify.posterior.coordinates import Fitted
from slipid.identify.posterior.diagnosis import Diagnosis


@dataclass(frozen=True, eq=False)
class Posterior:
    """Draws, and whether and why they may be believed.

    Effects are what runs of a session share, in stds. Log density, names and diagnosis are of the
    first stage; accepted is the part of the moves that moved something, by stage. Of the second
    stage's walkers, still is the part with a group that never moved, unsettled the worst drift or
    memory, 1 where it is just enough.
    """

    z: Float[np.ndarray, "ensemble draw free"]
    log_variance: Float[np.ndarray, "ensemble draw variance"]
    effects: Float[np.ndarray, "ensemble draw effect"]
    fitted: Fitted
    log_prob: Float[np.ndarray, "ensemble draw"]
    names: tuple[str, ...]
    diagnosis: Diagnosis
    accepted: dict[str, float]
    still: float
    unsettled: float
    converged: bool
    reason: str
