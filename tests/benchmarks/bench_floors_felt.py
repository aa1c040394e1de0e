"""Floor of a skid-steer robot by currents and a gyro alone, without a pose.

    make bench
    .venv/bin/python -m pytest -s -o python_files='bench_*.py' tests/benchmarks/bench_floors_felt.py

(about three minutes of one processor). The runs of "borealtc": a Husky on five floors, 6.5 rows a
second, currents without a sign. Prints how often slipid's floor filter and the classifiers beside
it name the right floor of held-out runs, by the seconds of signals, and which floors slipid named.
Without a pose the parameters of a floor only reproduce its currents and its turning; they are no
identification, and frictions are in units of the motors' unknown torque constant.
"""

from pathlib import Path

import pytest

from slipid.lab.benchmark.floors.tasks import HUSKY_FOLDER, HuskyFloorTask
from slipid.lab.benchmark.work import BenchmarkOptions
from tests.benchmarks.quick import QUICK


def test_floors_that_are_felt(real_data: Path, tmp_path: Path) -> None:
    if not (real_data / HUSKY_FOLDER).is_dir():
        pytest.skip(f"no logs of robots without a pose: {real_data / HUSKY_FOLDER} is no folder")
    table = HuskyFloorTask(BenchmarkOptions(real_data, tmp_path, quick=QUICK)).make()
    print(f"\n{table['about']}: {table['runs']} runs; chance {100 * table['chance']:.0f} %")
    for row in table["rows"]:
        shown = [
            "{:g} s {:3.0f} [{:.0f}, {:.0f}]".format(
                a["seconds"], *(100 * x for x in a["accuracy"])
            )
            for a in row["after"]
        ]
        print(f"{row['name']:24}", "  ".join(shown))
    own = table["rows"][0]
    print(f"slipid after {own['after'][-1]['seconds']:g} s, of stretches on a floor [%]")
    for floor, said in own["said"].items():
        print(f"{floor:11}", ", ".join(f"{name} {part:.0f}" for name, part in said.items()))
    by_name = {row["name"]: [a["accuracy"].value for a in row["after"]] for row in table["rows"]}
    assert QUICK or by_name["slipid"][-1] > 0.6
    assert QUICK or by_name["slipid"][-1] > by_name["slipid"][0] > 1.5 * table["chance"]
    assert QUICK or by_name["boosted_trees"][-1] > by_name["boosted_trees_driving"][-1]
