"""The floors of `borealtc`: a Husky that feels five of them, without a pose."""

from pathlib import Path

from slipid.baselines.floors.boosted_trees import tree_rows
from slipid.baselines.floors.cosine_energy import CosineEnergy
from slipid.baselines.floors.gaussian import Gaussian
from slipid.baselines.floors.interface import FloorMethod
from slipid.benchmark.felt.husky import RADIUS, ZERO_A, husky
from slipid.benchmark.felt.protocol import Asked, felt_table
from slipid.benchmark.felt.reading import read_felt
from slipid.benchmark.felt.result import FeltTable
from slipid.benchmark.felt.slipid_row import SlipidFloors
from slipid.identify.compare.slip_model import Machine

FOLDER = "borealtc"
ABOUT = (
    "Husky on five floors, no pose: wheel speeds, sizes of currents and a gyro, 6.5 rows a second"
)


def felt_rows() -> list[FloorMethod]:
    """All classifiers, slipid first, unfitted."""
    own = SlipidFloors(robot=husky(), zero_a=ZERO_A)
    return [own, CosineEnergy(), Gaussian(), *tree_rows()]


def felt_benchmark(data: Path, quick: bool = False, only: tuple[str, ...] = ()) -> FeltTable:
    """The table of all classifiers, or of those that are named.

    Args:
        data: folder with the data sets.
        quick: one fold, short times, settings as they are.
        only: names of rows; all where there are none.

    Raises:
        DataError: the folder's files cannot be read.
    """
    felts = read_felt(data / FOLDER, RADIUS)
    machine = Machine.of(husky().on(["any"]))
    methods = [method for method in felt_rows() if not only or method.name in only]
    return felt_table(methods, felts, machine, ABOUT, Asked.quick() if quick else Asked())
