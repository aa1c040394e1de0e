"""Splits of the protocols, and tuning of methods on training runs alone."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from slipid.lab.benchmark.protocols import PROTOCOLS, base_of, facts_of_run, inner, splits
from slipid.lab.benchmark.tuning import _loss, tuned
from slipid.lab.systems.motion.quann import QuannEnergy
from slipid.predict.folds import FoldKey
from slipid.predict.slip_model import PredictedRun, RobotSpec, SlipModel, path_of
from slipid.predict.slip_models import LEAST_RUNS, ByFloor
from tests.helpers.made_runs import ROBOTINO, made_run, straight


def facts(floors=("gray", "green"), speeds=(0.1, 0.2)):
    return [FoldKey(f, 10.0 * k, v) for f in floors for v in speeds for k in range(36)]


def test_every_protocol_has_splits_of_its_kind():
    kinds = {p.split for p in PROTOCOLS.values()}
    assert kinds == {"headings", "sectors", "speeds", "floors", "all"}


@pytest.mark.parametrize("kind", ["headings", "sectors", "speeds", "floors"])
def test_runs_are_held_out_once_and_never_trained_on_then(kind):
    every = facts()
    found = splits(every, kind)
    judged = np.concatenate([split.held_out for split in found])
    assert sorted(judged.tolist()) == list(range(len(every)))
    for split in found:
        assert not set(split.held_out.tolist()) & set(split.training.tolist())
        assert len(split.held_out) + len(split.training) == len(every)


def test_a_held_out_heading_is_trained_on_no_floor():
    every = facts()
    for split in splits(every, "headings"):
        left_out = {every[k].heading_deg for k in split.held_out}
        assert not left_out & {every[k].heading_deg for k in split.training}


def test_sectors_of_sixty_degrees_are_left_out_whole():
    every = facts()
    for split in splits(every, "sectors"):
        ways = {int(every[k].heading_deg // 60) for k in split.held_out}
        assert len(ways) == 3
        assert not ways & {int(every[k].heading_deg // 60) for k in split.training}


def test_a_floor_driven_at_one_speed_keeps_it():
    every = [*facts(), *facts(("table",), (0.1,))]
    for split in splits(every, "speeds"):
        assert "table" not in {every[k].floor for k in split.held_out}


def test_a_load_driven_at_one_speed_keeps_it_and_a_floor_is_left_out_with_all_loads():
    every = [*facts(), *facts(("gray@moved",), (0.1,))]
    for split in splits(every, "speeds"):
        assert "gray@moved" not in {every[k].floor for k in split.held_out}
    left_out = [{every[k].floor for k in split.held_out} for split in splits(every, "floors")]
    assert left_out == [{"gray", "gray@moved"}, {"green"}]


def test_many_speeds_are_two_halves():
    rng = np.random.default_rng(0)
    every = [FoldKey("grass", 0.0, float(v)) for v in rng.uniform(0.5, 3.0, 60)]
    found = splits(every, "speeds")
    assert [abs(len(split.held_out) - 30) < 3 for split in found] == [True, True]
    fastest = [max(every[k].speed for k in split.held_out) for split in found]
    assert fastest == sorted(fastest)


def test_a_floor_with_one_heading_is_not_held_out_by_heading():
    lone = [FoldKey("ice", 0.0, 0.1)] * 3
    for split in splits([*facts(), *lone], "headings"):
        assert not [k for k in split.held_out if k >= len(facts())]


def test_too_few_runs_are_no_split():
    assert splits(facts()[:6], "headings") == []


def test_the_load_is_no_part_of_the_floors_name():
    assert base_of("gray@moved") == base_of("gray") == "gray"


def runs(floors=("gray", "green"), slip=0.3):
    out = []
    for k, floor in enumerate(floors):
        for n, way in enumerate(np.radians(np.arange(0, 360, 20))):
            rolling = straight(way, 0.1 if n % 2 else 0.2)
            out.append(made_run(rolling, (1 - slip * k) * rolling, floor=floor, name=f"{floor}{n}"))
    return out


def test_inner_parts_are_of_the_protocols_kind():
    training = runs()
    by_floor = inner(training, "floors")
    left_out = {run.floor for run, k in zip(training, by_floor, strict=True) if k == 0}
    seen = {run.floor for run, k in zip(training, by_floor, strict=True) if k != 0}
    assert len(left_out) == len(seen) == 1
    by_speed = inner(training, "speeds")
    assert len({(round(r.speed, 2), k) for r, k in zip(training, by_speed, strict=True)}) == 2
    one_speed = [run for run in training if run.speed < 0.15]
    headings = inner(one_speed, "speeds")
    assert 0 < np.mean(headings == 0) < 1
    assert headings.tolist() == inner(one_speed, "headings").tolist()


def test_headings_are_held_back_where_every_other_sector_is_missing_already():
    every = runs()
    split = splits([facts_of_run(run) for run in every], "sectors")[0]
    training = [every[k] for k in split.training]
    assert inner(training, "sectors").tolist() == inner(training, "headings").tolist()


@dataclass(frozen=True)
class Scaled(SlipModel):
    """Encoders times a factor, which is a setting."""

    name: str = "scaled"
    factor: float = 1.0
    seen: tuple[str, ...] = ()

    def candidates(self):
        return [replace(self, factor=f) for f in (1.0, 0.85, 0.5)]

    def fit(self, runs, spec: RobotSpec):
        return replace(self, seen=tuple(run.signals.name for run in runs))

    def predict(self, runs, spec: RobotSpec):
        assert not {run.name for run in runs} & set(self.seen)
        return [PredictedRun(path_of(self.factor * r.rolling(spec), r.dt)) for r in runs]

    @property
    def numbers(self):
        return 0


def test_the_best_setting_of_training_runs_is_picked():
    found = tuned(ByFloor.of(Scaled()), runs(slip=0.5)[18:], ROBOTINO, "headings")
    assert found.settings == "factor = 0.5"
    assert found.tried == 3
    pooled = tuned(Scaled(), runs(slip=0.3), ROBOTINO, "headings")
    assert pooled.settings == "factor = 0.85"


@dataclass(frozen=True)
class Hungry(Scaled):
    """Encoders with the right factor if they were fitted to runs on several floors."""

    factor: float = 1.0

    def candidates(self):
        return [self]

    def fit(self, runs, spec: RobotSpec):
        several = len({run.floor for run in runs}) > 1
        return replace(super().fit(runs, spec), factor=0.5 if several else 1.0)


def test_a_method_by_floor_may_do_better_with_one_fit_for_all():
    training = [run.with_floor(True) for run in runs(slip=0.5)]
    assert len({run.floor for run in training}) > 1
    found = tuned(ByFloor.of(Hungry()), training, ROBOTINO, "headings")
    assert (found.settings, found.tried) == ("one fit to all runs", 2)
    done = found.method.fit(training, ROBOTINO)
    assert isinstance(done, ByFloor)
    assert list(done.fitted) == [None]
    untold = [run.with_floor(False) for run in training]
    assert tuned(ByFloor.of(Hungry()), untold, ROBOTINO, "headings").tried == 1
    # what is as good with floors apart keeps them apart
    assert tuned(ByFloor.of(Scaled()), training, ROBOTINO, "headings").settings == "factor = 0.5"


def test_floors_count_alike_whatever_number_of_runs_they_have():
    few = runs(slip=0.5)[:24]  # 18 on the first floor, six on the second
    held = np.array([0] * 9 + [-1] * 9 + [0] * 3 + [-1] * 3)
    # encoders are right on the first and twice as far as the robot on the second
    assert _loss(Scaled(), few, held, ROBOTINO) == pytest.approx(0.5)


def test_runs_whose_floor_was_left_out_altogether_do_not_count():
    few = [run.with_floor(True) for run in runs(slip=0.5)[:20]]
    held = np.array([0] * 6 + [-1] * 12 + [0] * 2)  # both runs on the second floor
    method = ByFloor.of(Scaled())
    assert few[-1].floor not in {run.floor for run in few[:18]}
    assert _loss(method, few, held, ROBOTINO) == pytest.approx(0.0)
    # told of no floor, it is judged by them
    untold = [run.with_floor(False) for run in few]
    assert _loss(method, untold, held, ROBOTINO) > 0.05


class Stubborn(Scaled):
    """Model with one setting whose fit raises."""

    def fit(self, runs, spec: RobotSpec):
        if self.factor == 0.5:
            raise ValueError("no")
        return super().fit(runs, spec)


def test_a_setting_that_fails_is_not_picked():
    assert tuned(Stubborn(), runs(slip=0.5)[18:], ROBOTINO, "headings").settings == "factor = 0.85"


@dataclass(frozen=True)
class Mean(Scaled):
    """Encoders times the mean factor of the training runs."""

    def fit(self, runs, spec: RobotSpec):
        slip = np.mean([r.twist[0, :2] @ r.signals.rolling(spec)[0, :2] for r in runs])
        size = np.mean([(r.signals.rolling(spec)[0, :2] ** 2).sum() for r in runs])
        return replace(self, factor=float(slip / size))


def test_a_method_by_floor_has_one_fit_for_all_unknown_floors():
    fitted = ByFloor.of(Mean()).fit(runs(slip=0.5), ROBOTINO)
    untold = ByFloor.of(Mean()).fit([run.with_floor(False) for run in runs(slip=0.5)], ROBOTINO)
    way = made_run(straight(0.1), name="new")

    def far(method, floor):
        measured = replace(way.signals, floor=floor)
        return method.predict([measured], ROBOTINO)[0].path[-1, 0] / way.pose[-1, 0]

    assert far(fitted, "gray") == pytest.approx(1.0)
    assert far(fitted, "green") == pytest.approx(0.5)
    assert far(untold, None) == pytest.approx(0.75)
    with pytest.raises(ValueError, match="scaled: no floor 'ice'; fitted: gray, green"):
        far(fitted, "ice")


def test_a_floor_of_few_runs_has_the_fit_to_all():
    few = runs(slip=0.5)[: 18 + LEAST_RUNS - 1]
    done = ByFloor.of(Mean()).fit(few, ROBOTINO)
    assert list(done.fitted) == ["gray", "green"]
    everything = Mean().fit(few, ROBOTINO)
    assert done.fitted["green"] == everything
    assert done.fitted["gray"] == Mean().fit(few[:18], ROBOTINO)
    enough = ByFloor.of(Mean()).fit(runs(slip=0.5)[: 18 + LEAST_RUNS], ROBOTINO)
    assert enough.fitted["green"] != everything


@dataclass(frozen=True)
class Powered(Scaled):
    """Encoders with a power, which is a setting."""

    watts: float = 1.0

    def candidates(self):
        return [replace(self, watts=w) for w in (90.0, 10.0, 3.0)]

    def predict(self, runs, spec: RobotSpec):
        predicted = super().predict(runs, spec)
        return [
            replace(s, power=np.full(len(r), self.watts))
            for s, r in zip(predicted, runs, strict=True)
        ]


def test_what_predicts_energy_is_tuned_by_it():
    way = straight(0.1)
    training = [
        made_run(way, 0.5 * way, current=np.full((40, 3), 1.0), name=f"run{k}") for k in range(9)
    ]
    watts = float(training[0].signals.power(ROBOTINO).mean())
    assert watts == pytest.approx(10.0, rel=0.1)
    assert tuned(Powered(), training, ROBOTINO, "headings").settings == "watts = 90.0"
    found = tuned(Powered(aim="energy"), training, ROBOTINO, "headings")
    assert found.settings == "watts = 10.0"
    assert ByFloor.of(QuannEnergy()).aim == "energy"


def test_with_unknown_floors_each_load_has_a_fit_and_a_new_load_that_of_the_usual():
    every = [run.with_floor(False) for run in runs(slip=0.5)]
    names = {"gray": "own", "green": "moved"}

    def loaded(run, load):
        return replace(run, signals=replace(run.signals, load=load))

    training = [loaded(run, names[run.floor]) for run in every][1:]
    done = ByFloor.of(Mean()).fit(training, ROBOTINO)
    assert list(done.fitted) == ["moved", "own"]

    def end(load):
        return done.predict([loaded(every[0], load).signals], ROBOTINO)[0].path[-1]

    assert not np.allclose(end("own"), end("moved"))
    assert np.allclose(end("never seen"), end("moved"))
