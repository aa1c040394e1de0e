"""Rows of the benchmark's tables: every published system, roughly in order of its year."""

from slipid.lab.paper2021.deployed_form import paper_rows
from slipid.lab.systems.motion.gmdh import GmdhClass, GmdhOne
from slipid.lab.systems.motion.learners import BoostedTrees, NeuralNetwork
from slipid.lab.systems.motion.ojeda import ojeda_rows
from slipid.lab.systems.motion.quann import QuannEnergy, QuannSlip
from slipid.lab.systems.motion.reina import ReinaDeterministic, ReinaFuzzy
from slipid.lab.systems.motion.ward_iagnemma import WardIagnemma
from slipid.predict.kinematics import Corrected, Encoder, HeadingLookup
from slipid.predict.slip_model import RobotSpec, SlipModel
from slipid.predict.slip_models import ByFloor

KINEMATIC = ("effective_track", "instantaneous_centres")
"""Names of the rows that are only for robots whose wheels do not determine the twist."""


def _every() -> list[SlipModel]:
    """Return all methods before their fit.

    Methods that do not handle floors themselves are wrapped in a model that fits them per floor.
    """
    of_one_floor: list[SlipModel] = [
        *(Corrected(name) for name in KINEMATIC),
        ReinaDeterministic(),
        ReinaFuzzy(),
        WardIagnemma(),
        WardIagnemma.with_current(),
        QuannSlip(),
        QuannEnergy(),
        *paper_rows(),
        HeadingLookup(),
        BoostedTrees(),
        NeuralNetwork(),
    ]
    by_floor = [ByFloor.of(method) for method in of_one_floor]
    return [Encoder(), *ojeda_rows(), *by_floor, GmdhOne(), GmdhClass()]


ROWS = tuple(method.name for method in _every())
"""Names of the rows of all published systems."""


def rows(spec: RobotSpec) -> list[SlipModel]:
    """Return the unfitted methods for a robot, whether or not it logs the channels they need."""
    every = _every()
    if spec.determines_twist:
        every = [method for method in every if method.name not in KINEMATIC]
    return every
