"""Time of a step of the generated C, also with many wheels and floors, and of its contact balance.

How it is run is at the head of `export_builds.py`. All times are of one process written in C, over
a drive on the twin.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from slipid.deploy.controllers import control_loop_of
from slipid.exports.c99.builder import Names
from slipid.exports.c99.code import Code
from slipid.exports.c99.function import Argument, function
from slipid.exports.c99.text import table
from slipid.exports.text import template
from slipid.lab.trial.controllers import ROWS
from slipid.model import contact
from slipid.model.contact_balance import stand
from slipid.model.geometry import differential, mecanum
from slipid.robot import trajectory
from slipid.robot.filter import hypotheses
from slipid.robot.filter.hypotheses import hypotheses_of
from tests.benchmarks.export_builds import (
    FAST,
    HERE,
    KINDS,
    PATH,
    PLAIN,
    THREE,
    Fleet,
    code,
    driven,
    needs,
    ran,
    three_floors,
)
from tests.benchmarks.quick import QUICK, quick
from tests.helpers.exported import known

BARS_NS = {"slip_odometry": 500.0, "contact": 10_000.0}
BESIDE = 1.3
SECONDS = quick(3.0, 0.1)
FLAGS = {"-O3 -march=native -fno-math-errno -fno-trapping-math": FAST, "-O2": PLAIN}
pytestmark = needs("gcc")


@dataclass(frozen=True)
class Took:
    """Times of one code [ns]: median and shortest of its passes; state: its size [byte]."""

    median: float
    least: float
    state: int


def timed(folder: Path, drive: Path, flags) -> Took:
    """Return the times of the code in a folder."""
    words = ["gcc", "-std=c99", *flags, "-I.", HERE / "export_time.c", "slipid.c", "-lm"]
    ran([*words, "-o", "timed"], folder)
    median, least, state = ran(["./timed", drive, SECONDS], folder).split()[:3]
    return Took(float(median), float(least), int(state))


def unfleeted(made: Code, folder: Path) -> Path:
    """The code alone, in a folder of its own."""
    folder.mkdir(exist_ok=True)
    (folder / "slipid.h").write_text(made.header())
    (folder / "slipid.c").write_text(made.source())
    return folder


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("row", BARS_NS)
def test_step(tmp_path, row, kind):
    fleet = Fleet(code(row), tmp_path, (*FAST, *KINDS[kind]))
    drive = driven(code(row), three_floors(), fleet).write(tmp_path / "drive")
    alone = unfleeted(code(row), tmp_path / "alone")
    for name, flags in FLAGS.items():
        more = ("-fno-tree-pre",) if kind == "float" and flags == FAST else ()
        took = timed(alone, drive, (*flags, *KINDS[kind], *more))
        print(
            f"\n{row} {kind} {' '.join((name, *more))}: median {took.median:.0f} ns a step "
            f"({took.median / BARS_NS[row]:.2f} of the bar), least {took.least:.0f}; "
            f"state {took.state} byte",
            end="",
        )
        if kind == "double" and flags == FAST:
            assert QUICK or took.median <= BARS_NS[row]


def settled(folder: Path) -> tuple[int, np.ndarray]:
    """Generated code of the contact balance alone, and the same floors as its twin has them."""
    f = three_floors()
    under = hypotheses_of(f).under
    on = stand(f.frame, f.floors.at(under.T), f.rest)
    count = len(under)
    arguments = (
        Argument.plain("start", (3, count)),
        Argument.plain("rim", (f.wheels,)),
        Argument.plain("twist", (3, count), False, True),
        Argument.plain("felt", (f.wheels, count), False, True),
    )
    names = Names()
    made = function(
        names,
        "settled",
        arguments,
        lambda start, rim: contact.settle(start, rim, rim, on, f.inverse),
    )
    head = [
        "#include <float.h>",
        "#include <math.h>",
        "#include <stdbool.h>",
        "#include <stdint.h>",
    ]
    lines = [*head, "typedef double slipid_real;", template("c99/prelude.c"), f"{made.head};"]
    lines += [x for m in names.tables.values() if m.name in made.reads for x in table(m)]
    (folder / "settled.c").write_text("\n".join([*lines, *made.text]))
    floor, rows = on.floor, []
    for k in range(count):
        one = [f.frame.hold, f.frame.roll, f.frame.shift, on.rest[:, k], f.inverse, f.frame.base]
        per_wheel = (floor.friction, floor.creep, floor.roller_drag, floor.roller_creep)
        per_wheel += (floor.rolling_resistance, floor.slide_viscosity, floor.roller_viscosity)
        per_wheel += (floor.knee_width,)
        one += [jnp.broadcast_to(x, (f.wheels, count))[:, k] for x in per_wheel]
        one += [jnp.broadcast_to(x, count)[k] for x in (floor.scrub, floor.lead)]
        rows.append(np.concatenate([np.asarray(x).ravel() for x in one]))
    return count, np.array(rows)


def test_contact_balance_beside_its_twin(tmp_path):
    count, floors = settled(tmp_path)
    rng, steps = np.random.default_rng(0), 1000
    speed = 3 * rng.normal(size=(1, 3)) + 0.2 * rng.normal(size=(steps, 3)).cumsum(0)
    rims = float(three_floors().frame.radius) * speed
    counts = np.array([steps, count], np.int64)
    (tmp_path / "given").write_bytes(counts.tobytes() + rims.tobytes() + floors.tobytes())
    sizes = [
        f"-DCOMBINATIONS={count}",
        f"-DCHORDS={contact.chord_steps(three_floors().wheels)}",
        f"-DNEWTONS={contact.SETTLE_NEWTON_STEPS}",
    ]
    twin = f'-DTWIN="{HERE / "twin.c"}"'
    for name, flags in FLAGS.items():
        words = ["gcc", "-std=c99", *flags, *sizes, twin, HERE / "export_settle.c", "settled.c"]
        ran([*words, "-lm", "-o", "settled"], tmp_path)
        ours, theirs, apart = map(float, ran(["./settled", "given"], tmp_path).split()[:3])
        print(
            f"\ncontact balance of {count} combinations, {name}: generated {ours:.0f} ns, by hand "
            f"{theirs:.0f} ns, ratio {ours / theirs:.2f} (bar {BESIDE}); twists apart {apart:.1e}",
            end="",
        )
        assert apart < 1e-9
        assert QUICK or ours <= BESIDE * theirs


# other drives -----------------------------------------------------------------------------------


def test_differential_robot_beside_omni_robot(tmp_path):
    """Whole steps of the contact controller on two floors, one after the other in turns."""
    floors, circle = ("firm", "soft"), trajectory.arc(0.35, -12 * np.pi)
    shapes = {"omni": THREE, "differential": differential(0.2, 0.04)}
    folders, took = {}, {name: [] for name in shapes}
    for name, shape in shapes.items():
        robot = known(shape, floors)
        path = PATH if robot.holonomic else trajectory.tangent([circle]).after_rest(1.0)
        made = Code(robot, control_loop_of(robot, ROWS["contact"]), path)
        fleet = Fleet(made, tmp_path, FAST)
        drive = driven(made, robot, fleet, 400).write(tmp_path / f"{name}_drive")
        folders[name] = unfleeted(made, tmp_path / name), drive
    for _ in range(quick(3, 1)):
        for name, (folder, drive) in folders.items():
            took[name].append(timed(folder, drive, FAST).median)
    omni_ns, other_ns = (float(np.median(took[name])) for name in shapes)
    print(
        f"\ntwo floors: omni {omni_ns:.0f} ns a step, differential {other_ns:.0f} ns, "
        f"ratio {other_ns / omni_ns:.2f}",
        end="",
    )
    assert QUICK or other_ns <= omni_ns


# many wheels and floors --------------------------------------------------------------------------

NS_EACH = 1000.0
"""Bar of a step's time over the number of combinations: it must not grow faster than they do."""
ALL = 99
"""More changes of floor than there are wheels."""


@pytest.mark.parametrize(
    ("floors", "changes"),
    quick([(2, 2), (3, 2), (4, 2), (5, 2), (2, ALL), (3, ALL), (4, ALL), (5, ALL)], [(2, 2)]),
)
def test_many_floors(tmp_path, monkeypatch, floors, changes):
    monkeypatch.setattr(hypotheses, "MOST_CHANGES", changes)
    robot = known(mecanum(0.2, 0.15, 0.05, 20.0), [f"floor{k}" for k in range(floors)])
    made = Code(robot, control_loop_of(robot, ROWS["contact"]), PATH)
    fleet = Fleet(made, tmp_path, FAST)
    drive = driven(made, robot, fleet, 400).write(tmp_path / "drive")
    took = timed(unfleeted(made, tmp_path / "alone"), drive, FAST)
    print(
        f"\nfour wheels, {floors} floors, {len(hypotheses_of(robot))} of {floors**4} combinations: "
        f"median {took.median / 1000:.1f} us a step, least {took.least / 1000:.1f}; state "
        f"{took.state} byte, source {len(made.source()) / 1024:.0f} KiB",
        end="",
    )
    assert QUICK or took.median <= NS_EACH * len(hypotheses_of(robot))
