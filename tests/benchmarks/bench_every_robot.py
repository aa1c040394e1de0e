"""The proving ground: thirty made robots of every drive, slipid beside what a user can do alone.

    make bench
    .venv/bin/python -m pytest -s -o python_files='bench_*.py' tests/benchmarks/bench_every_robot.py

(about a minute for a robot and a seed, eight seeds each; `-k omni` for some robots,
SLIPID_BENCH_SEEDS=1 for fewer seeds, SLIPID_BENCH_FITS=0 for calibrations without the rest of a
fit: about five seconds for a robot and a seed). What is finished is kept in out/bench_every_robot,
so that an interrupted run goes on.

Robots, their logs and the rivals share nothing with slipid (tests/benchmarks/every_robot). Every
row is open loop from the first pose of fresh runs with other paths and speeds: the distance of the
predicted end from the measured one, over the path length, mean over runs and seeds. Rows:

- nominal: the numbers of the config;
- squares: robust least squares with scipy on radii, track or base, lever arm and lag;
- floor: the true numbers, so that the noise of wheels and poses is all that is left;
- numbers: those of slipid's calibration (`slipid.fitting.calibration`), with the judge's equations;
- calibrated, contact, selected: slipid's slip models, as far as `slipid validate` knows them.

Asserts that least squares reaches the noise floor where kinematics are all there is, and that
slipid's selected model (the calibration's numbers where poses are not whole) is nowhere behind the
better of the two rivals by more than a tenth and 0.1 % of the path.

Real robots are judged elsewhere: Robotino 2022 in bench_left_out.py, another omni robot in
bench_omni3.py, Warthog and Husky in bench_skid.py; each prints its own rows.
"""

from __future__ import annotations

import json
import os
import time
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

from tests.benchmarks.every_robot import drive, fits, rivals, score
from tests.benchmarks.every_robot.robots import ROBOTS, MadeRobot
from tests.benchmarks.quick import quick
from tests.benchmarks.record import record

ROOT = Path(__file__).resolve().parents[2]
SOURCES = [*(ROOT / "slipid").rglob("*.py"), *(ROOT / "tests/benchmarks/every_robot").glob("*.py")]
CODE = sha256(b"".join(path.read_bytes() for path in sorted(SOURCES)))
FITS = os.environ.get("SLIPID_BENCH_FITS", "1") not in ("", "0")
# nothing of other code is reused
OUT = ROOT / "out" / "bench_every_robot" / CODE.hexdigest()[:8] / ("fits" if FITS else "alone")
SEEDS = int(os.environ.get("SLIPID_BENCH_SEEDS", quick("8", "1")))
FEW = ("diff_umbmark", "diff_positions", "mecanum_wrong_base", "bicycle_zero")
TRIED = [robot for robot in ROBOTS if robot.name in quick([r.name for r in ROBOTS], FEW)]
ROWS = "nominal", "squares", "floor", "numbers", "calibrated", "contact", "selected"


def measured(robot: MadeRobot, seed: int, folder: Path) -> dict:
    """Return the rows, verdict and coverage of one robot and seed, as they are kept."""
    began = time.monotonic()
    truth = drive.write(robot, folder, seed)
    fresh = rivals.read(robot, folder / "fresh")
    fitted = rivals.least_squares_fit(robot, rivals.read(robot, folder / "logs"))
    own, right = rivals.nominal(robot), rivals.true(robot)
    rows = {
        "nominal": score.row(robot, rivals.kinematic(robot, own), own, fresh, truth),
        "squares": score.row(
            robot, rivals.kinematic(robot, fitted.numbers), fitted.numbers, fresh, truth
        ),
        "floor": score.row(robot, rivals.truth(robot), right, fresh, truth),
    }
    inside, found = {}, fits.calibration(robot, folder)
    if isinstance(found, dict):
        k = fits.kinematics(found)
        rows["numbers"] = score.row(robot, rivals.kinematic(robot, k), k, fresh, truth)
        inside = fits.covered(robot, found)
    said = fits.Answer(found if isinstance(found, str) else "calibrated alone")
    answer = fits.answer(robot, folder, truth) if FITS else said
    rows |= {name: answer.rows[name] for name in ROWS[4:] if name in answer.rows}
    return {
        "robot": robot.name,
        "seed": seed,
        "rows": rows,
        "verdict": answer.verdict,
        "selected": answer.selected,
        "covered": {"squares": score.covered(robot, fitted), "slipid": inside | answer.inside},
        "seconds": time.monotonic() - began,
    }


@pytest.mark.parametrize("robot", TRIED, ids=lambda robot: robot.name)
def test_robot(robot: MadeRobot, tmp_path: Path) -> None:
    records = []
    for seed in range(SEEDS):
        kept = OUT / robot.name / f"{seed}.json"
        if not kept.exists():
            folder = tmp_path / str(seed)
            folder.mkdir()
            record = measured(robot, seed, folder)
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_text(json.dumps(record, indent=1), encoding="utf-8")
        records.append(json.loads(kept.read_text(encoding="utf-8")))
    print(f"\n{HEAD}\n{line(records)}")
    rows = mean_rows(records)
    if robot.determined:
        assert rows["squares"] < (1.5 if SEEDS >= 8 else 3.0) * rows["floor"] + 0.1
    assert rows["floor"] < min(rows["squares"], rows["nominal"]) + 0.3


HEAD = (
    f"{'robot':22}" + "".join(f"{name:>11}" for name in ROWS) + "  in 90 %: squares slipid  verdict"
)


def mean_rows(records: list[dict]) -> dict[str, float]:
    """Mean of every row over floors and seeds, of those that every seed has."""
    each = [
        {name: float(np.mean(list(floors.values()))) for name, floors in record["rows"].items()}
        for record in records
    ]
    names = [name for name in ROWS if all(name in rows for rows in each)]
    return {name: float(np.mean([rows[name] for rows in each])) for name in names}


def recorded(rows: dict[str, float]) -> list[float | None]:
    """Return the errors of a robot in the order of the documentation's columns [%]."""
    shown = "nominal", "squares", "calibrated", "contact", "selected", "floor"
    return [round(rows[name], 2) if name in rows else None for name in shown]


def line(records: list[dict]) -> str:
    """One line of the table."""
    rows = mean_rows(records)
    cells = "".join(f"{rows[name]:11.2f}" if name in rows else f"{'-':>11}" for name in ROWS)
    for who, width in (("squares", 17), ("slipid", 7)):
        inside = [held for record in records for held in record["covered"][who].values()]
        cells += f"{np.mean(inside):{width}.0%}" if inside else f"{'-':>{width}}"
    verdicts = [record["verdict"] for record in records]
    counted = {v: verdicts.count(v) for v in dict.fromkeys(verdicts)}
    said = ", ".join(v if n == len(verdicts) else f"{n} {v}" for v, n in counted.items())
    return f"{records[0]['robot']:22}{cells}  {said.splitlines()[0][:90]}"


def behind(records: list[dict]) -> str | None:
    """Return why slipid is behind the rivals, or None."""
    rows = mean_rows(records)
    best = min(rows["nominal"], rows["squares"])
    deployed = rows.get("selected", rows.get("numbers"))  # only whole poses can be validated
    if deployed is None:
        return f"{records[0]['robot']}: no answer ({records[0]['verdict'].partition(':')[0]})"
    if deployed > 1.1 * best + 0.1:
        return f"{records[0]['robot']}: {deployed:.2f} % of the path, a rival {best:.2f} %"
    return None


def test_table() -> None:
    """The whole table, also as every_robot.json, and the robots on which slipid is behind."""
    found = {
        robot.name: [json.loads(path.read_text()) for path in sorted(OUT.glob(f"{robot.name}/*"))]
        for robot in TRIED
    }
    found = {name: records for name, records in found.items() if records}
    print(f"\nend-point error in % of the path, {SEEDS} seeds\n{HEAD}")
    print("\n".join(line(records) for records in found.values()))
    late = [sentence for records in found.values() if (sentence := behind(records))]
    print(f"slipid is behind on {len(late)} of {len(found)} robots", *late, sep="\n  ")
    table = {name: mean_rows(records) for name, records in found.items()}
    record("every_robot", ([name, *recorded(rows)] for name, rows in table.items()))
    content = {"rows": table, "behind": late, "records": found}
    (OUT / "every_robot.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
    assert quick(len(found) == len(ROBOTS) and not late, True)
