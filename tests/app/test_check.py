"""Expected verdicts before a fit, and whether the fit keeps them."""

from functools import partial

import pytest

from slipid.app.check import expected
from slipid.app.config import FitSection
from slipid.app.problem import FitTask, robot_for_runs
from slipid.data.runs import collect
from slipid.fitting.optimise import optimise
from slipid.infer.summary import summarise
from slipid.lab.selftest.logs import (
    SimulatedSensors,
    heading_grid,
    nominal_robot,
    simulate_logs,
    true_robot,
)
from slipid.search_space import Choice

PLAN = heading_grid(setups=(("soft", "as_built"),), headings=8, speeds=(0.1, 0.2))
CHOICES = (Choice("motor.*", free=False), Choice("camera.scale", free=True))
ORDER = ("not_identified", "weak", "identified")
fit = partial(optimise, most_rounds=15)


def promised_and_kept(times, creep):
    """Verdicts before and after the fit of runs with so many times the usual noise."""
    usual = SimulatedSensors()
    std = {name: (times if "floor" in name else 1) * v for name, v in usual.std.items()}
    logs = simulate_logs(
        true_robot(PLAN, {"surface.soft.creep": creep}), PLAN, 3, SimulatedSensors(std=std)
    )
    data = collect(logs)
    task = FitTask(
        data, robot_for_runs(nominal_robot(PLAN), data, (0.0, 0.0)), CHOICES, FitSection()
    )
    problem = task.problem()
    before = expected(task, problem)
    after = summarise(problem, fit(problem), data, CHOICES)
    return before.parameters, after.parameters


@pytest.mark.slow
@pytest.mark.parametrize(("times", "creep"), [(1, 0.45), (12, 0.45), (12, 3.0)])
def test_nothing_is_promised_that_the_fit_does_not_keep(times, creep):
    before, after = promised_and_kept(times, creep)
    assert before.keys() == after.keys()
    broken = [
        path
        for path, e in before.items()
        if e.verdict == "identified" and after[path].verdict in ORDER[:2]
    ]
    assert broken == []
    # the fit contradicts no more than one range in twenty
    outside = [path for path, e in before.items() if not e.allows(after[path].verdict)]
    assert len(outside) <= 0.05 * len(before), outside
    # a range of all verdicts, which no fit contradicts, would say nothing
    everything = [path for path, e in before.items() if all(map(e.allows, ORDER))]
    assert len(everything) < 0.5 * len(before), everything
    if times == 1:
        assert any(e.best.verdict == "identified" for e in before.values())
