"""Floor classification without a pose: reading, folds, answers, intervals, slipid's own row."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import expit, logit
from scipy.stats import t as student

from slipid.lab.benchmark.floors.fitting import (
    Cells,
    MeteredMotor,
    clipped,
    currents_off,
    fitted_floors,
    on_floor,
    scatter_of,
    shown,
    stiffness_of,
)
from slipid.lab.benchmark.floors.protocol import (
    EvaluationSettings,
    answers_of,
    classifier_table,
    folds_of,
    tuned_classifier,
)
from slipid.lab.benchmark.floors.result import Answer, after_seconds, confusion
from slipid.lab.benchmark.floors.slipid_row import SlipidFloorClassifier, kinds
from slipid.lab.benchmark.floors.tasks import (
    COLUMNS,
    NO_LOAD_A,
    NO_LOAD_SLOPE,
    REST_READING_A,
    HuskyFloorTask,
    RobotinoFloorTask,
    beliefs_of,
    floor_signals,
    husky,
    husky_classifiers,
    read_floor_runs,
    robotino_classifiers,
)
from slipid.lab.benchmark.scores import FoldScore
from slipid.lab.benchmark.work import BenchmarkOptions
from slipid.lab.systems.floors.interface import FloorClassifier, floors_of
from slipid.predict.slip_model import PredictedRun
from slipid.support.errors import DataError
from slipid.support.files import json_text
from tests.helpers.made_floor_runs import HZ, ahead, made_floor_run, made_floor_runs
from tests.helpers.made_runs import HUSKY, made_run, straight


@dataclass(frozen=True)
class Meter(FloorClassifier):
    """Classifier that takes the floor with the nearest mean current, plus an error `off`."""

    name: str = "meter"
    off: float = 0.0
    tries: tuple[float, ...] = ()
    level: dict[str, float] = field(default_factory=dict)

    def candidates(self):
        return [replace(self, off=off) for off in self.tries] or (self,)

    def fit(self, runs, spec):
        labels = floors_of(runs)
        level = {
            name: float(np.mean([f.current.mean() for f in runs if f.floor == name]))
            for name in labels
        }
        return replace(self, labels=labels, level=level)

    def probability(self, runs, spec):
        out = []
        for run in runs:
            mean = np.cumsum(run.current.mean(axis=1)) / np.arange(1, len(run) + 1) + self.off
            gap = np.stack([-np.abs(mean - self.level[name]) for name in self.labels], axis=1)
            out.append(np.exp(gap) / np.exp(gap).sum(axis=1, keepdims=True))
        return out

    @property
    def numbers(self):
        return len(self.level)


HEADER = ",".join(COLUMNS)


def written(path, rows, header=HEADER):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([header, *rows]) + "\n")


def row(t, **other):
    value = {"curL": 1.0, "curR": 2.0, "velL": 0.33, "velR": 0.165, "gyro_z": 0.1, "accel_std": 0.5}
    return ",".join(str(x) for x in {"time": t, **value, **other}.values())


def test_a_file_is_a_run_and_a_gap_makes_two(tmp_path):
    written(tmp_path / "ICE" / "00.csv", [row(t) for t in (0, 0.15, 0.3, 1.0, 1.15, 1.3, 1.45)])
    written(tmp_path / "SNOW" / "00.csv", [row(0), row(0.15, gyro_z=""), row(0.3)])
    ice, more, snow = read_floor_runs(tmp_path, 0.165)
    assert [len(r) for r in (ice, more, snow)] == [3, 4, 3]
    assert (ice.name, ice.floor, snow.floor) == ("ICE/00", "ice", "snow")
    assert ice.speed[0] == pytest.approx([2.0, 1.0])
    assert ice.current[0].tolist() == [1.0, 2.0]
    assert ice.gyro[0] == 0.1
    assert ice.vibration[0] == 0.5
    assert np.isnan(snow.gyro[1])
    assert more.time[0] == 1.0


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([row(0), row(0.1), row(0.1)], "row 4, column 'time': does not increase"),
        ([row(0), row(0.1, curL=""), row(0.2)], "row 3, column 'curL': no number"),
        ([row(0), row(0.1, curL="x"), row(0.2)], "row 3, column 'curL'"),
        ([row(0), "1,2", row(0.2)], "row 3"),
        ([row(0)], "1 rows; expected at least 3"),
    ],
)
def test_a_bad_file_is_named_with_its_row(tmp_path, rows, message):
    written(tmp_path / "ICE" / "00.csv", rows)
    with pytest.raises(DataError, match=r"00\.csv") as error:
        read_floor_runs(tmp_path, 0.165)
    assert message in str(error.value)


def test_a_missing_column_and_a_missing_folder_are_named(tmp_path):
    with pytest.raises(DataError, match=r"no file FLOOR/RUN\.csv"):
        read_floor_runs(tmp_path, 0.165)
    written(tmp_path / "ICE" / "00.csv", ["0,1"], "time,curL")
    with pytest.raises(DataError, match="column 'curR': no such column"):
        read_floor_runs(tmp_path, 0.165)


def test_every_run_is_left_out_once_and_floors_are_in_every_fold():
    runs = made_floor_runs({"grass": 2.0, "snow": 4.0}, runs=7)
    runs = [*runs[:1], *runs[7:9], *runs[1:7], *runs[9:]]
    fold = folds_of(runs, 3)
    assert fold.tolist() == [0, 0, 1, 1, 2, 0, 1, 2, 0, 2, 0, 1, 2, 0]
    assert sorted(set(fold.tolist())) == [0, 1, 2]
    for k in range(3):
        assert {f.floor for f, n in zip(runs, fold, strict=True) if n == k} == {"grass", "snow"}
    assert [np.sum(fold == k) for k in range(3)] == [6, 4, 4]


def test_stretches_have_an_answer_after_each_time_that_they_last():
    runs = made_floor_runs({"grass": 2.0, "snow": 4.0}, rows=20)
    done = Meter().fit(runs, HUSKY)
    answers = answers_of(done, runs[:1], HUSKY, (0.5, 1.0, 2.0))
    # 20 rows are one stretch of 2 s, 13 rows, and one that ends after 7 rows, 1.08 s
    assert [a.seconds for a in answers] == [0.5, 1.0, 2.0, 0.5, 1.0]
    assert {a.named for a in answers} == {"grass"}
    part = runs[0].rows(0, 13)
    beliefs = done.probability([part], HUSKY)[0]
    assert answers[0].probability == pytest.approx(beliefs[2, 0])  # 3 rows are 0.46 s
    assert answers[2].probability == pytest.approx(beliefs[12, 0])


def test_a_stretch_of_a_robot_at_rest_has_no_answer():
    runs = made_floor_runs({"grass": 2.0, "snow": 4.0}, rows=13)
    done = Meter().fit(runs, HUSKY)
    speed = runs[0].speed.copy()
    speed[:9] = 0.0
    answers = answers_of(done, [replace(runs[0], speed=speed)], HUSKY, (0.5, 2.0))
    assert answers == []
    speed[3:9] = 1.0
    answers = answers_of(done, [replace(runs[0], speed=speed)], HUSKY, (0.5, 2.0))
    assert [a.seconds for a in answers] == [2.0]


def test_settings_are_picked_by_runs_that_the_candidate_was_not_fitted_to():
    runs = made_floor_runs({"grass": 2.0, "snow": 4.0})
    found = tuned_classifier(
        Meter(tries=(9.0, 0.0, 5.0)), runs, HUSKY, EvaluationSettings(seconds=(1.0,))
    )
    assert found.method.off == 0.0
    assert found.settings == "off = 0.0"
    assert tuned_classifier(
        Meter(tries=(9.0, 0.0)), runs, HUSKY, EvaluationSettings(inner=1)
    ).method.tries == (9.0, 0.0)


@dataclass(frozen=True)
class Memory(Meter):
    """Classifier that names the first floor in its training runs, and the last in all others."""

    name: str = "memory"
    known: frozenset[str] = frozenset()
    right: bool = False

    def candidates(self):
        return [self, replace(self, right=True)]

    def fit(self, runs, spec):
        return replace(self, labels=floors_of(runs), known=frozenset(f.name for f in runs))

    def probability(self, runs, spec):
        seen = [f.name in self.known for f in runs]
        each = [np.array([0.9, 0.1]) if s else np.array([0.1, 0.9]) for s in seen]
        return [np.tile(p, (len(f), 1)) for p, f in zip(each, runs, strict=True)]


@pytest.mark.parametrize("judged", [1, 3])
def test_training_runs_have_no_answers(judged):
    runs = made_floor_runs({"grass": 2.0, "snow": 4.0}, runs=6)
    table = classifier_table(
        [Memory()], runs, HUSKY, "made", EvaluationSettings((1.0,), 3, judged), "memory"
    )
    assert table["rows"][0]["said"]["grass"] == {"grass": 0.0, "snow": 100.0}
    assert len(table["rows"][0]["settings"]) == judged


def answer(run, right, probability=0.5, floor="grass"):
    return Answer(run, floor, 1.0, floor if right else "other", probability)


def test_accuracies_and_differences_by_hand():
    mine = [answer("a", 1, 0.8), answer("a", 0, 0.2), answer("b", 1), answer("c", 1, floor="snow")]
    other = [answer("a", 0), answer("a", 0), answer("b", 1), answer("c", 1, floor="snow")]
    found = after_seconds(mine, other)[0]
    assert found["stretches"] == 4
    assert found["accuracy"].value == 0.75
    assert found["balanced"].value == pytest.approx(0.5 * (2 / 3 + 1))
    assert found["behind"] is not None
    assert found["behind"].value == 0.25
    assert found["by_floor"] == {"grass": pytest.approx(2 / 3), "snow": 1.0}
    assert found["log_score"] == pytest.approx(np.log([0.8, 0.2, 0.5, 0.5]).mean())
    assert found["accuracy"].low is None  # there are three runs
    assert after_seconds(mine, None)[0]["behind"] is None


def test_the_interval_of_an_accuracy_by_hand():
    right = np.array([1, 1, 1, 1, 0, 1, 1, 0, 1, 1])
    found = after_seconds([answer(f"r{k}", r) for k, r in enumerate(right)], None)[0]["accuracy"]
    half = student.isf(0.05, 9) * right.std() / 3
    ends = expit(logit(0.8) + np.array([-half, half]) / (0.8 * 0.2))
    assert (found.low, found.high) == pytest.approx(tuple(ends))


def test_stretches_of_one_run_are_no_independent_witnesses():
    rng = np.random.default_rng(0)
    level = rng.random(20) < 0.5
    together = [answer(f"r{k}", level[k]) for k in range(20) for _ in range(30)]
    apart = [answer(f"r{n}", a.named == "grass") for n, a in enumerate(together)]
    width = [
        after_seconds(some, None)[0]["accuracy"].high - after_seconds(some, None)[0]["accuracy"].low
        for some in (together, apart)
    ]
    # std of 20 independent runs against that of 600
    assert width[0] / width[1] == pytest.approx(np.sqrt(30), rel=0.2)
    assert width[0] == pytest.approx(2 * 1.645 * np.sqrt(0.25 / 20), rel=0.25)


def test_the_confusion_table_is_in_percent():
    answers = [answer("a", 1), answer("a", 0), answer("b", 1, floor="snow")]
    assert confusion(answers, 1.0) == {
        "grass": {"grass": 50.0, "other": 50.0, "snow": 0.0},
        "snow": {"grass": 0.0, "other": 0.0, "snow": 100.0},
    }


def test_a_table_compares_all_rows_with_the_reference():
    runs = made_floor_runs({"grass": 2.0, "snow": 4.0}, runs=5)
    good, bad = Meter(name="good"), Meter(name="bad", off=1.5)
    table = classifier_table(
        [good, bad], runs, HUSKY, "made", EvaluationSettings(seconds=(1.0, 4.0)), "good"
    )
    first, second = table["rows"]
    assert first["after"][0]["accuracy"].value == 1.0
    assert first["after"][0]["behind"] is None
    assert second["after"][0]["accuracy"].value == pytest.approx(0.5, abs=0.1)
    after = second["after"][0]
    assert after["behind"].value == pytest.approx(after["accuracy"].value - 1.0)
    assert table["chance"] == 0.5
    assert (table["runs"], table["floors"]) == (10, ["grass", "snow"])
    assert first["said"]["grass"] == {"grass": 100.0, "snow": 0.0}
    assert first["said"]["snow"] == {"grass": 0.0, "snow": 100.0}
    assert '"accuracy"' in json_text(table)


def test_a_quick_table_is_of_one_fold_and_of_the_first_minute():
    runs = made_floor_runs({"grass": 2.0, "snow": 4.0}, runs=5, rows=600)
    settings = EvaluationSettings.quick()
    table = classifier_table([Meter()], runs, HUSKY, "made", settings, "meter")
    after = table["rows"][0]["after"]
    assert [a["seconds"] for a in after] == [0.5, 1.0, 2.0]
    # of each floor one run, of which a minute is 30 stretches
    assert [a["stretches"] for a in after] == [60, 60, 60]


def test_rows_have_names_of_their_own_and_slipid_is_first():
    names = [method.name for method in husky_classifiers()]
    assert names[0] == "slipid"
    assert len(set(names)) == len(names)


def test_a_meter_that_shows_no_braking_shows_the_mean_of_what_is_left():
    rng = np.random.default_rng(0)
    for mean in (-3.0, -0.5, 0.0, 1.0, 6.0):
        drawn = np.maximum(rng.normal(mean, 2.0, 200_000), 0.0).mean()
        assert float(clipped(jnp.asarray(mean), jnp.asarray(2.0))) == pytest.approx(drawn, abs=0.02)


def test_a_metered_motor_shows_its_current_its_stiffness_and_no_braking():
    plain = husky().motor
    motor = MeteredMotor.of(plain, jnp.array([-0.5, 0.5]), jnp.asarray(0.1))
    torque, w = jnp.array([30.0, 30.0]), jnp.array([2.0, 2.0])
    amps = plain.current(torque, w)
    assert np.allclose(motor.current(torque, w), amps + jnp.array([-0.5, 0.5]), atol=1e-3)
    assert np.allclose(motor.current(-torque, -w), amps + jnp.array([-0.5, 0.5]), atol=1e-3)
    assert np.allclose(motor.current(-torque, w), 0.0, atol=1e-3)
    still = motor.current(jnp.zeros(2), jnp.zeros(2))
    assert float(jnp.max(still)) < 0.1


def test_cells_are_means_of_rows_at_the_same_speeds():
    speed = np.array([[1, 1], [2, 1], [1, 1], [0, 0], [1, 1.0]])
    run = replace(
        made_floor_run("grass", speed, 2.0),
        current=np.array([[1, 2], [5, 6], [2, 3], [9, 9], [3, 7.0]]),
        gyro=np.array([0.1, 0.5, np.nan, 9.0, 0.3]),
    )
    cells = Cells.of(run)
    assert cells.rows.tolist() == [3, 1]
    assert cells.current == pytest.approx(np.array([[2, 4], [5, 6]]))
    assert cells.gyro == pytest.approx([0.2, 0.5])
    assert cells.std[0] == pytest.approx([np.std([1, 2, 3]), np.std([2, 3, 7])])
    n = 3 * np.array([3 / 1.15, 1 / 1.05]) / (1 + 4 / 300)
    assert cells.weight[:, 0] == pytest.approx(np.sqrt(n))
    assert cells.weight[:, 1] == pytest.approx(np.sqrt(n * [2 / 3, 1]))
    few = Cells.joined([run, run]).thinned(3)
    assert (few.weight > 0).all()
    many = Cells.joined([run, run]).thinned(6)
    assert (many.weight[4:] == 0).all()


def test_stiffness_is_measured_in_straight_motion():
    runs = made_floor_runs({"grass": 2.0, "snow": 4.0}, noise=0.0)
    stiff = [replace(f, current=f.current + np.array([-0.4, 0.4])) for f in runs]
    bend = replace(stiff[0], speed=np.tile([1.0, 3.0], (60, 1)), current=np.tile([0, 9.0], (60, 1)))
    assert stiffness_of([*stiff, bend]) == pytest.approx([-0.4, 0.4])
    assert stiffness_of([bend]).tolist() == [0.0, 0.0]


def test_scatter_is_that_of_rows_at_the_same_speeds():
    runs = [
        made_floor_run("grass", ahead(rate=rate), 5.0 * rate, noise=0.7, seed=k)
        for k, rate in enumerate((1.0, 2.0, 3.0))
    ]
    assert scatter_of(runs) == pytest.approx(0.7, rel=0.1)


def test_kinds_of_motion_are_straight_bends_and_on_the_spot():
    wheels = np.array([[1, 1], [-1, -1], [1, 1.1], [1, 2], [0, 1], [-1, 1], [1, -1]], dtype=float)
    assert kinds(made_floor_run("grass", wheels, 1.0), HUSKY).tolist() == [0, 0, 0, 1, 2, 2, 2]


def ground(friction: dict[str, float]):
    """Return a Husky with ammeters on floors that differ in friction only."""
    robot = husky().on(tuple(friction))
    surfaces = replace(
        robot.surfaces, lead=jnp.zeros(len(friction)), drag_exponent=jnp.ones(len(friction))
    )
    motor = MeteredMotor.of(robot.motor, jnp.array([-0.5, 0.5]), jnp.asarray(0.5))
    robot = replace(robot, surfaces=surfaces, motor=motor)
    for k, name in enumerate(robot.surfaces.labels):
        robot = on_floor(robot, jnp.asarray(k), jnp.log(jnp.array([friction[name], 0.1, 0.05])))
    return robot


def driven(robot, runs: int = 4, noise: float = 0.5, seed: int = 0):
    """Return runs with pairs of wheel speeds of two seconds each, and their ammeter readings."""
    made = []
    for k, floor in enumerate(robot.surfaces.labels):
        for n in range(runs):
            rng = np.random.default_rng(1000 * seed + 100 * k + n)
            pairs = rng.uniform(-2.0, 3.0, (8, 2)).round(1)
            pairs[0] = pairs[4] = 2.0
            speed = np.repeat(pairs, 13, axis=0)
            amps, turn = shown(robot, jnp.asarray(k), jnp.asarray(speed))
            current = np.asarray(amps) + REST_READING_A + noise * rng.normal(size=speed.shape)
            gyro = np.asarray(turn) + 0.02 * rng.normal(size=len(speed))
            run = made_floor_run(floor, speed, 0.0, name=f"{floor}/{seed}{n}")
            made.append(replace(run, current=np.abs(current), gyro=gyro))
    return made


@pytest.fixture(scope="module")
def slippery():
    return ground({"grass": 0.7, "ice": 0.2, "snow": 0.45})


@pytest.mark.slow
def test_frictions_are_found_by_currents_and_turning(slippery):
    runs = [
        replace(f, current=np.maximum(f.current - REST_READING_A, 0))
        for f in driven(slippery, noise=0.1)
    ]
    start = ground({"grass": 0.4, "ice": 0.4, "snow": 0.4})
    found = fitted_floors(start, runs).surfaces.friction
    assert np.allclose(found, slippery.surfaces.friction, rtol=0.1)
    off = currents_off(slippery, 1, runs[4].speed, runs[4].current)
    assert np.std(off) == pytest.approx(0.1, rel=0.4)
    wrong = currents_off(slippery, 0, runs[4].speed, runs[4].current)
    assert np.std(wrong) > 1.0


@pytest.mark.slow
def test_slipid_classifies_floors_that_differ_in_friction_only_without_later_signals(slippery):
    method = SlipidFloorClassifier(robot=husky(), zero_a=REST_READING_A).fit(
        driven(slippery), HUSKY
    )
    assert method.labels == ("grass", "ice", "snow")
    assert np.asarray(method.fitted.motor.stiffness) == pytest.approx([-0.5, 0.5], abs=0.2)
    judged = driven(slippery, runs=3, seed=1)
    # the mean pair of speeds turns: each is heard for the first four pairs
    beliefs = method.probability(judged, HUSKY)
    for run, p in zip(judged, beliefs, strict=True):
        assert p.shape == (len(run), 3)
        assert np.allclose(p.sum(axis=1), 1.0)
        assert method.labels[int(p[-1].argmax())] == run.floor
    half = len(judged[0]) // 2
    other = judged[-1]
    spliced = replace(
        judged[0],
        speed=np.concatenate([judged[0].speed[:half], other.speed[half:]]),
        current=np.concatenate([judged[0].current[:half], other.current[half:]]),
        gyro=np.concatenate([judged[0].gyro[:half], other.gyro[half:]]),
    )
    changed = method.probability([spliced], HUSKY)[0]
    assert np.allclose(changed[:half], beliefs[0][:half], atol=1e-9)
    assert not np.allclose(changed[half:], beliefs[0][half:])


def test_slipid_raises_without_robot_or_fit():
    with pytest.raises(ValueError, match="not fitted"):
        SlipidFloorClassifier(robot=husky()).probability(made_floor_runs({"grass": 2.0}), HUSKY)
    with pytest.raises(ValueError, match="no robot was given"):
        SlipidFloorClassifier().fit(made_floor_runs({"grass": 2.0}), HUSKY)


class Broken(Meter):
    """Classifier whose fit raises."""

    def fit(self, runs, spec):
        raise ZeroDivisionError("no wheel")


def test_a_classifier_that_fails_has_an_empty_row_beside_the_others():
    runs = made_floor_runs({"grass": 2.0, "snow": 4.0})
    methods = [Broken(name="broken"), Meter()]
    table = classifier_table(
        methods, runs, HUSKY, "made", EvaluationSettings(seconds=(1.0,)), "broken"
    )
    lost, there = table["rows"]
    assert (lost["name"], lost["absent"]) == ("broken", "ZeroDivisionError: no wheel")
    assert lost["after"] == []
    assert there["after"][0]["accuracy"].value > 0.5
    assert there["after"][0]["behind"] is None
    with pytest.raises(ValueError, match="no wheel"):
        classifier_table(
            methods[:1], runs, HUSKY, "made", EvaluationSettings(seconds=(1.0,)), "broken"
        )


def in_the_air(root: Path) -> tuple[float, float, float]:
    """Return `REST_READING_A`, `NO_LOAD_A` and `NO_LOAD_SLOPE` by runs of a Husky with its wheels
    in the air.

    Rows count in which a wheel keeps its speed.
    """
    speed, amps = [], []
    for path in sorted(root.glob("*.csv")):
        rows = np.genfromtxt(path, delimiter=",", names=True)
        for side in "lr":
            w, i = rows[f"w{side}"], rows[f"i{side}"]
            steady = np.isfinite(w) & np.isfinite(i)
            steady &= np.abs(np.gradient(np.nan_to_num(w))) < 0.05
            speed.append(np.abs(w[steady]))
            amps.append(i[steady])
    w, i = np.concatenate(speed), np.concatenate(amps)
    zero = float(np.median(i[w < 0.02]))
    moving = w > 0.5
    # above three amperes a wheel is no longer free
    slope, level = np.polyfit(w[moving], np.minimum(i[moving] - zero, 3.0), 1)
    return zero, float(level), float(slope)


def test_a_free_wheel_draws_what_was_measured(real_data):
    folder = real_data / "drive_skid" / "husky_in_the_air"
    if not folder.is_dir():
        pytest.skip(f"no logs of wheels in the air: {folder} is no folder")
    assert in_the_air(folder) == pytest.approx((REST_READING_A, NO_LOAD_A, NO_LOAD_SLOPE), rel=0.05)


def test_a_robotino_run_enters_without_its_pose():
    amps = np.tile([-0.5, 1.0, 2.0], (40, 1))
    run = made_run(straight(0.3), current=amps, signed=True, floor="gray@moved")
    signals = floor_signals(run)
    assert (signals.floor, signals.name) == ("gray", run.signals.name)
    assert signals.dt.sum() == pytest.approx(4.0)
    assert np.array_equal(signals.speed, run.signals.speed)
    assert signals.current[0].tolist() == [0.5, 1.0, 2.0]
    with pytest.raises(ValueError, match="no current"):
        floor_signals(made_run(straight(0.3)))


def test_what_the_estimator_calls_unknown_is_left_out_of_the_comparison():
    floors = {"gray": np.array([0.3]), "green": np.array([0.1]), "unknown": np.array([0.6])}
    labels, beliefs = beliefs_of(PredictedRun(np.zeros((2, 3)), floors=floors))
    assert labels == ("gray", "green")
    assert beliefs == pytest.approx(np.array([[0.75, 0.25]]))


def test_a_classifier_that_fails_in_one_fold_has_an_empty_row():
    lost = FoldScore.of_error(ValueError("no leaf"))
    there = FoldScore((answer("a", 1),), numbers=4)
    assert FoldScore.of_folds([there, lost]).absent == "ValueError: no leaf"
    assert FoldScore.of_folds([there, lost]).runs == ()
    assert FoldScore.of_folds([there, there]) == replace(there, runs=there.runs * 2)


def test_rows_on_the_robotino_use_no_vibration():
    names = [method.name for method in robotino_classifiers()]
    assert "boosted_trees_vibration" not in names
    assert {"belyaev_kushnarev", "gaussian", "boosted_trees"} <= set(names)


@pytest.mark.nightly
def test_slipid_is_ahead_of_all_classifiers_on_the_robotino(real_data, tmp_path):
    part = RobotinoFloorTask(BenchmarkOptions(real_data, tmp_path, quick=True))
    if not part.is_requested:
        pytest.skip(f"no logs of the Robotino in {real_data}")
    assert part.run() == "robotino_floors"
    table = part.table()
    after = {row["name"]: row["after"][2]["accuracy"][0] for row in table["rows"]}
    assert after["slipid"] == max(after.values())
    assert after["slipid"] > 0.85


def test_a_table_is_made_if_its_logs_exist_and_a_row_is_requested(tmp_path):
    assert not HuskyFloorTask(BenchmarkOptions(tmp_path, tmp_path)).is_requested
    (tmp_path / "borealtc").mkdir()
    assert HuskyFloorTask(BenchmarkOptions(tmp_path, tmp_path)).is_requested
    assert HuskyFloorTask(BenchmarkOptions(tmp_path, tmp_path, ("gaussian",))).is_requested
    assert not HuskyFloorTask(BenchmarkOptions(tmp_path, tmp_path, ("encoder",))).is_requested
    assert not RobotinoFloorTask(BenchmarkOptions(tmp_path, tmp_path)).is_requested


def test_a_table_that_fails_is_kept_with_its_reason_until_the_logs_change(tmp_path):
    (tmp_path / "borealtc").mkdir()
    part = HuskyFloorTask(BenchmarkOptions(tmp_path, tmp_path / "out"))
    assert part.run() == "husky_floors"
    assert "no file FLOOR/RUN.csv" in part.table()["failed"]
    written(tmp_path / "borealtc" / "ICE" / "00.csv", ["0,1,1,1,1,0,0"])
    assert part.table() == {"failed": "the result was not saved"}
    part.run()
    assert "1 rows" in part.table()["failed"]


def test_a_table_in_which_a_classifier_failed_is_made_again(tmp_path, monkeypatch):
    (tmp_path / "borealtc").mkdir()
    part = HuskyFloorTask(BenchmarkOptions(tmp_path, tmp_path / "out"))
    runs = made_floor_runs({"grass": 2.0, "snow": 4.0})
    methods = [Broken(name="trees"), Meter()]
    made = []

    def make(_):
        made.append(len(made))
        return classifier_table(
            methods, runs, HUSKY, "made", EvaluationSettings(seconds=(1.0,)), "meter"
        )

    monkeypatch.setattr(HuskyFloorTask, "make", make)
    part.run()
    assert part.table()["rows"][0]["absent"] == "ZeroDivisionError: no wheel"
    methods[0] = Meter(name="trees")
    part.run()
    assert part.table()["rows"][0]["absent"] == ""
    part.run()
    assert made == [0, 1]


def test_seconds_are_of_rows_that_come_as_often_as_they_do():
    assert made_floor_run("grass", ahead(13), 1.0).dt.sum() == pytest.approx(13 / HZ)
