"""The rows of the benchmark's tables: every published system, in the order of its year or so."""

from slipid.baselines.motion.boosted_trees import BoostedTrees
from slipid.baselines.motion.gmdh.method import GmdhClass, GmdhOne
from slipid.baselines.motion.neural_network import NeuralNetwork
from slipid.baselines.motion.ojeda import ojeda_rows
from slipid.baselines.motion.paper import paper_rows
from slipid.baselines.motion.quann.energy import QuannEnergy
from slipid.baselines.motion.quann.slip import QuannSlip
from slipid.baselines.motion.reina.method import ReinaDeterministic, ReinaFuzzy
from slipid.baselines.motion.ward_iagnemma.method import WardIagnemma
from slipid.identify.compare.heading_lookup import HeadingLookup
from slipid.identify.compare.kinematics import Corrected, Encoder
from slipid.identify.compare.slip_model import ByFloor, Machine, SlipModel

KINEMATIC = ("effective_track", "instantaneous_centres")
"""Rows for wheels that do not determine the twist."""


def _every() -> list[SlipModel]:
    """All methods, unfitted; those that handle floors themselves as they are."""
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
"""Their names."""


def rows(machine: Machine) -> list[SlipModel]:
    """Methods for a robot, unfitted; those that lack a channel they need are among them."""
    every = _every()
    if machine.determines_twist:
        every = [method for method in every if method.name not in KINEMATIC]
    return every
