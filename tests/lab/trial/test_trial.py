"""Paths, metrics and the trial command."""

import json
from dataclasses import asdict, replace
from inspect import signature
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.cli.trial import trial as command
from slipid.data.floor_map import four_zones, uniform, write_map
from slipid.deploy.controllers import centre_of, control_loop_of
from slipid.deploy.floors import floor_map, floor_of
from slipid.deploy.twin_run import path_of, starts
from slipid.lab.testsite.config import plan
from slipid.lab.testsite.driving import PERIOD
from slipid.lab.testsite.site import Site, SiteSensors
from slipid.lab.trial import trial as tr
from slipid.lab.trial.controllers import (
    ROWS,
    TruePosePlant,
    applicable,
)
from slipid.lab.trial.published_laws import GoswamiPadhy
from slipid.lab.trial.summary import TrialRun, best_controllers, columns, summaries, verdict
from slipid.lab.trial.trial import SitePlant, drawn_robot, refuse_unknown_to_site
from slipid.model.geometry import differential, mecanum, omni, skid_steer
from slipid.model.robot import build
from slipid.robot import closed_loop
from slipid.robot import trajectory as reference
from slipid.robot.closed_loop import ControlLoop
from slipid.robot.controller import Controller
from slipid.robot.deployed import DeployedRobot
from slipid.robot.estimator import Estimator, Odometry
from slipid.robot.filter.floor import Floor
from slipid.robot.filter.floor_filter import FloorFilter
from slipid.robot.filter.hypotheses import hypotheses_of
from slipid.robot.gains import Gains
from slipid.robot.interface import Measurement, Settings
from slipid.robot.record import ActuatorRecord, Setting
from slipid.robot.robot_file import typed
from slipid.support.errors import DataError
from slipid.support.toml_file import text_of
from tests.helpers.floors import surface_at
from tests.helpers.known_robot import deploy_known
from tests.helpers.unicycle import Unicycle

CONFIGS = Path(__file__).resolve().parents[3] / "configs"
GYRO_SITE = Site(sensors=SiteSensors(gyro=True))


@pytest.fixture(scope="module")
def deployed():
    robot = build(omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0), ["firm", "soft"])
    return deploy_known(robot, highest_speed=7.5)


def control_loop(deployed, preview=0.0):
    gains = replace(Gains(), preview=jnp.asarray(preview))
    return ControlLoop(Odometry(deployed), Controller(deployed, gains))


@pytest.mark.slow
@pytest.mark.parametrize("name", reference.PATHS)
def test_encoders_close_every_path_without_slip(deployed, name):
    start = (0.2, 0.1, -1.0)
    path = reference.PATHS[name](0.2).moved(start)
    course = closed_loop.run_closed_loop(
        control_loop(deployed, 0.05), path, Unicycle(deployed, start), start
    )
    found = closed_loop.path_metrics(course)
    assert found.finished
    assert found.closure_mm < 5
    assert found.cross_track_rmse_mm < 10
    assert abs(found.heading_error_deg) < 0.5


@pytest.fixture(scope="module")
def pair():
    """A robot with two wheels."""
    return deploy_known(build(differential(0.2, 0.04), ["firm"]), highest_speed=20.0)


MORE = {
    "there and back": [reference.PathSection(0.5), reference.PathSection(-0.5)],
    "with arcs": reference.rectangle_shape(1.35, 0.6, 0.2),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", [*reference.SHAPES, *MORE])
@pytest.mark.parametrize("beside", [(0.0, 0.0, 0.0), (0.0, -0.1, 1.5)])
def test_a_robot_that_does_not_drive_sideways_closes_its_paths(pair, name, beside):
    path = reference.tangent(MORE[name]) if name in MORE else path_of(name, 0.2, pair)
    loop = ControlLoop(Odometry(pair), Controller(pair))
    plant = Unicycle(pair, beside, delay_s=0.1, lag_s=0.03)
    found = closed_loop.path_metrics(closed_loop.run_closed_loop(loop, path, plant, beside))
    assert found.finished
    assert found.closure_mm < 10
    assert abs(found.heading_error_deg) < 2
    assert found.cross_track_rmse_mm < (40 if any(beside) else 5)
    assert np.abs(found.along_track_mm).max() < 15


@pytest.mark.slow
def test_a_robot_that_turns_about_a_point_behind_its_middle_closes_the_rectangle(pair):
    behind, shape = -0.06, reference.SHAPES["rectangle"](1.5)
    skid = replace(pair, inverse=pair.inverse.at[1].set(-behind * pair.inverse[2]))
    assert centre_of(ROWS["encoder"], skid) == pytest.approx(behind)
    assert centre_of(ROWS["contact"], pair) == pytest.approx(0.0, abs=1e-6)
    loop, found = ControlLoop(Odometry(skid), Controller(skid)), {}
    for centre in (0.0, behind):
        path, plant = reference.tangent(shape, centre=centre), Unicycle(skid, delay_s=0.1)
        course = closed_loop.run_closed_loop(loop, path, plant, (0.0, 0.0, 0.0))
        found[centre] = closed_loop.path_metrics(course)
    assert found[0.0].closure_mm > 15  # the last turn moves the middle sideways
    assert found[behind].finished
    assert found[behind].closure_mm < 10
    assert found[behind].cross_track_rmse_mm < 10


@pytest.mark.slow
def test_turns_on_the_spot_have_no_side(deployed):
    sides = reference.PathSection(0.3), reference.Turn(np.pi), reference.PathSection(0.3)
    half = reference.Turn(-np.pi)
    for shape, expected in (([half], ()), ([*sides, half, half], (300.0, 300.0))):
        course = closed_loop.run_closed_loop(
            control_loop(deployed), reference.tangent(shape), Unicycle(deployed), (0.0, 0.0, 0.0)
        )
        found = closed_loop.path_metrics(course)
        assert found.finished
        assert found.sides_mm == pytest.approx(expected)
        np.testing.assert_allclose(found.along_track_mm, np.zeros(len(expected)), atol=10)
        assert found.closure_mm < 5
        assert abs(found.heading_error_deg) < 1.0


@pytest.mark.slow
def test_encoders_close_the_rectangle_without_slip_and_metrics_say_so(deployed):
    start = (0.2, 0.1, -1.0)
    path = reference.rectangle().moved(start)
    course = closed_loop.run_closed_loop(
        control_loop(deployed), path, Unicycle(deployed, start), start
    )
    found = closed_loop.path_metrics(course)
    assert found.finished
    assert found.closure_mm < 5
    assert found.cross_track_rmse_mm < 10
    assert found.energy_j is None  # this plant does not know
    assert np.abs(found.along_track_mm).max() < 10
    assert abs(found.heading_error_deg) < 0.5
    assert found.path_length_mm == pytest.approx(2600, rel=0.03)
    np.testing.assert_allclose(found.sides_mm, [900, 400, 900, 400], atol=1e-6)
    # a rest before the path begins changes none of them
    rest = 0.05 * np.arange(40)
    times = {k: np.append(rest, getattr(course, k) + 2.0) for k in ("time", "path_time")}
    rows = ("pose", "command", "energy", "recovering")
    held = {k: np.concatenate([getattr(course, k)[:1]] * 40 + [getattr(course, k)]) for k in rows}
    later = replace(course, path=path.after_rest(2.0), **times, **held)
    for name, value in asdict(closed_loop.path_metrics(later)).items():
        if value is not None:
            np.testing.assert_allclose(value, getattr(found, name), rtol=1e-6, err_msg=name)


@pytest.mark.slow
def test_rates_are_commanded_early_for_wheels_with_a_lag(deployed):
    start, path = (0.0, 0.0, 0.0), reference.waypoints([(0.0, 0.0), (0.9, 0.0)])
    far = []
    for preview in (0.0, 0.2):
        plant = Unicycle(deployed, start, delay_s=0.2)
        far.append(
            closed_loop.run_closed_loop(control_loop(deployed, preview), path, plant, start)
            .pose[:, 0]
            .max()
        )
    assert far[0] > 0.92  # four periods at 0.2 m/s too far
    assert far[1] < 0.905


@pytest.mark.slow
def test_metrics_see_a_robot_that_travels_only_part_of_its_way(deployed):
    start = (0.0, 0.0, 0.0)
    path = reference.rectangle()
    course = closed_loop.run_closed_loop(
        control_loop(deployed), path, Unicycle(deployed, start, radius=0.8, track=0.8), start
    )
    found = closed_loop.path_metrics(course)
    assert found.along_track_mm[0] == pytest.approx(-180, abs=12)
    assert found.along_track_mm[1] == pytest.approx(-80, abs=12)
    assert found.closure_mm < 12  # every side is as short as its opposite
    assert found.cross_track_rmse_mm > 30


@pytest.mark.slow
def test_of_a_curve_the_first_quarter_is_judged(deployed):
    start = (0.0, 0.0, 0.0)
    path = reference.PATHS["circle"](0.2)
    course = closed_loop.run_closed_loop(
        control_loop(deployed), path, Unicycle(deployed, start, radius=0.8, track=0.8), start
    )
    found = closed_loop.path_metrics(course)
    assert found.sides_mm[0] == pytest.approx(350 * np.sqrt(2), rel=0.01)
    run = TrialRun("encoder", start, 0, found, 0.0)
    assert float(columns([run])["first_side_travelled"][0]) == pytest.approx(0.8, abs=0.03)


@pytest.mark.slow
def test_a_robot_that_does_not_move_has_its_whole_path_left(deployed):
    path = reference.rectangle()
    plant = Unicycle(deployed, radius=0.0)
    course = closed_loop.run_closed_loop(control_loop(deployed), path, plant, (0.0, 0.0, 0.0))
    assert closed_loop.path_metrics(course).closure_mm < 5  # its encoders say that it has arrived
    course = replace(course, path_time=np.zeros_like(course.path_time))
    found = closed_loop.path_metrics(course)
    assert not found.finished
    assert found.closure_mm == pytest.approx(2600, abs=1)


def test_the_distance_from_a_path_is_from_its_line():
    line = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    places = np.array([[0.37, 0.2], [1.3, 0.63], [1.3, 1.4], [0.5, 0.0]])
    np.testing.assert_allclose(
        closed_loop._distance_from_line(places, line), [0.2, 0.3, 0.5, 0.0], atol=1e-12
    )


def test_rows_of_the_paper_have_its_loop_and_ours_the_designed_gains(deployed):
    late = ActuatorRecord(Setting(0.1, "logs"), Setting(0.03, "logs"))
    robot = DeployedRobot.of(replace(deployed.record, actuators=late))
    designed = Gains.of(robot)
    assert values(designed) != values(Gains())
    for row in ROWS.values():
        if row.law is not None or row.obstacle(robot):  # a law takes a second to make
            continue
        found = control_loop_of(robot, row).controller.gains
        expected = designed if row.designed else Gains()
        if row.observer in ("encoder", "curve"):
            expected = replace(expected, preview=jnp.asarray(0.0))
        assert values(found) == values(expected)


def test_a_law_stands_in_place_of_the_pose_loop(deployed):
    """With gains that are all the same the law of Goswami and Padhy is the pose loop."""
    gains = Gains(1.5, 1.5, 0.0, 0.0, 0.0)
    loop = Controller(deployed, gains)
    same, other = (
        Controller(deployed, gains, law=GoswamiPadhy(jnp.full(3, k))) for k in (1.5, 3.0)
    )
    odometry, rng = Odometry(deployed), np.random.default_rng(0)
    seen = odometry.step(odometry.init(), Measurement(np.zeros(3), np.full(3, 0.1)), 0.05)[1]

    def asked(controller, pose, reference):
        estimate = replace(seen, pose=jnp.asarray(pose))
        return np.asarray(controller.step(controller.init(), reference, estimate, 0.05)[1])

    for _ in range(5):
        pose = rng.normal(size=3)
        reference = jnp.asarray(np.hstack([pose + 0.01 * rng.normal(size=3), np.full(3, 0.01)]))
        wheels = asked(loop, pose, reference)
        assert np.abs(wheels).max() < 1.2  # no limit changes it
        np.testing.assert_allclose(asked(same, pose, reference), wheels, atol=1e-12)
        assert np.abs(asked(other, pose, reference) - wheels).max() > 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    "shape", [omni([60.0, 180.0, 300.0], 0.125, 0.04), mecanum(0.2, 0.15, 0.05)]
)
def test_rows_of_published_laws_are_made_for_the_robot_and_believe_its_encoders(shape):
    robot = build(shape, ["firm", "soft"])
    robot = eqx.tree_at(
        lambda r: (r.geometry.drive_offset, r.geometry.radius_deviation),
        robot,
        (0.01 * jnp.arange(shape.wheels), 0.02 * jnp.arange(shape.wheels)),
    )
    known = deploy_known(robot, highest_speed=7.5)
    loops = {
        name: control_loop_of(known, ROWS[name])
        for name in ("goswami_padhy", "goswami_padhy_gradient", "indiveri")
    }
    for control_loop in loops.values():
        assert not control_loop.estimator.curve
        assert values(control_loop.controller.gains) == values(
            replace(Gains(), preview=jnp.zeros(()))
        )
    law = loops["indiveri"].controller.law
    np.testing.assert_allclose(law.matrix, known.forward / known.frame.radius, atol=1e-9)
    assert law.gains.tolist() == [1.5, 1.5]
    assert float(law.limit) == 13.0
    swarm, gradient = (np.asarray(p.controller.law.gains) for p in list(loops.values())[:2])
    np.testing.assert_allclose(swarm, gradient, atol=1e-3)
    assert swarm.tolist()[:2] == [5.0, 5.0]  # the edge of what the paper's swarm may take
    assert 4.0 < swarm[2] < 4.999


@pytest.mark.slow
@pytest.mark.parametrize("row", ["goswami_padhy", "indiveri"])
def test_published_laws_close_the_rectangle_without_slip(deployed, row):
    start = (0.2, 0.1, -1.0)
    path = reference.rectangle().moved(start)
    control_loop = control_loop_of(deployed, ROWS[row], Settings())
    found = closed_loop.path_metrics(
        closed_loop.run_closed_loop(control_loop, path, Unicycle(deployed, start), start)
    )
    assert found.finished
    assert found.closure_mm < 5
    assert found.cross_track_rmse_mm < 10
    assert abs(found.heading_error_deg) < 0.5


def test_starts_are_spread_and_the_same_for_everyone():
    floor = uniform("firm", 2.0)
    every = starts(20, floor, reference.rectangle())
    assert every == starts(20, floor, reference.rectangle())
    headings = np.sort([s[2] for s in every])
    assert np.diff(headings).max() < 2 * 2 * np.pi / 20
    middles = []
    for x, y, h in every:
        c, s = np.cos(h), np.sin(h)
        middles.append((x + 0.45 * c + 0.2 * s, y + 0.45 * s - 0.2 * c))
    assert np.abs(middles).max() <= 1.2 + 1e-9
    assert np.std(middles, axis=0).min() > 0.4
    for start in starts(20, floor, reference.PATHS["eight"](0.2)):  # its middle is where it begins
        assert np.abs(start[:2]).max() <= 1.2 + 1e-3


@pytest.mark.slow
def test_a_robot_can_be_restricted_to_some_floors(deployed):
    a, b = deployed.labels
    only = deployed.on(b)
    assert only.labels == (b,)
    assert float(only.floors.friction[0]) == float(deployed.floors.friction[1])
    assert deployed.on(b, a).on(a).current_std == deployed.current_std[0]
    rim = jnp.asarray([3.0, -5.0, 2.0])
    assert only.record.labels == (b,)
    assert not any(path.startswith(f"surface.{a}") for path in only.record.parameters)
    alone, _ = FloorFilter(only, Settings()).solve(jnp.zeros((1, 3)), 0 * rim, rim)
    every, _ = FloorFilter(deployed, Settings()).solve(jnp.zeros((8, 3)), 0 * rim, rim)
    np.testing.assert_allclose(alone[0], every[-1], atol=1e-6)
    with pytest.raises(ValueError, match=f"no floor 'ice'; identified: {a}, {b}"):
        deployed.on("ice")
    for wrong in ((), (a, a)):
        with pytest.raises(
            ValueError, match=f"expected one or more of {a}, {b}, each at most once"
        ):
            deployed.on(*wrong)


LAB = """schema = "slipid.map/1"
base = "firm"
extent_m = [-1, -1, 1, 1]
cell_m = 0.05
[[patch]]
surface = "soft"
polygon = [[0, -1], [1, -1], [1, 1], [0, 1]]
"""


@pytest.mark.slow
def test_a_map_file_reaches_an_estimator_and_a_robot_that_has_numpy_alone(tmp_path, deployed):
    (tmp_path / "lab.toml").write_text(LAB)
    made = floor_map(tmp_path / "lab.toml", deployed)
    pose = jnp.array([0.9, 0.0, 0.0])
    estimator = Estimator(deployed, floor=made)
    state = estimator.init(pose)
    state, seen = estimator.step(state, Measurement([0.0] * 3, [0.1] * 3), 0.05)
    state, seen = estimator.step(state, Measurement([0.3, 0.0, -0.3], [0.1] * 3), 0.05)
    assert seen.surface.tolist() == ["soft"] * 3
    made.save(tmp_path / "lab.npz", deployed.labels)
    for labels, swapped in ((deployed.labels, False), (("soft", "firm"), True)):
        again = Floor.load(tmp_path / "lab.npz", labels)
        np.testing.assert_array_equal(again.cells, 1 - made.cells if swapped else made.cells)
        np.testing.assert_array_equal(again.corner, made.corner)
        assert float(again.cell) == float(made.cell)
    unknown = Floor.load(tmp_path / "lab.npz", ("firm",))
    assert set(np.unique(unknown.cells)) == {-1, 0}
    unknown.save(tmp_path / "lab.npz", ("firm",))  # what is unknown stays so
    again = Floor.load(tmp_path / "lab.npz", deployed.labels)
    np.testing.assert_array_equal(again.cells, unknown.cells)


def test_an_empty_map_and_a_damaged_one_are_refused(tmp_path, deployed):
    (tmp_path / "lab.toml").write_text(LAB.replace("firm", "ice").replace("soft", "mud"))
    with pytest.raises(DataError, match=r"\(ice, mud\); expected a map with one or more of fi"):
        floor_map(tmp_path / "lab.toml", deployed)
    with pytest.raises(DataError, match=r"absent\.npz: .*expected a map written by Floor\.save"):
        Floor.load(tmp_path / "absent.npz", deployed.labels)
    floor_of(uniform("firm"), deployed.labels).save(tmp_path / "one.npz", deployed.labels)
    whole = (tmp_path / "one.npz").read_bytes()
    for cut in (b"", whole[:100], whole[:-30], b"not a map"):
        (tmp_path / "cut.npz").write_bytes(cut)
        with pytest.raises(DataError, match="expected a map written"):
            Floor.load(tmp_path / "cut.npz", deployed.labels)
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    with pytest.raises(DataError, match="expected a map written"):
        Floor.load(tmp_path / "other.npz", deployed.labels)
    with pytest.raises(DataError, match=r"cut\.npz.*cannot be written"):
        floor_of(uniform("firm"), ("firm",)).save(tmp_path / "cut.npz" / "x.npz", ("firm",))


def test_a_map_is_looked_up_under_the_wheels(deployed):
    floor = four_zones(["firm", "soft", "firm", "soft"], middle=(0.0, 0.0))
    lookup = floor_of(floor, ("firm", "soft"))
    pose = jnp.asarray([0.02, -0.01, 0.7])
    under = np.asarray(lookup.under(pose, deployed.places))
    c, s = np.cos(0.7), np.sin(0.7)
    turned = np.asarray(deployed.places) @ np.array([[c, s], [-s, c]]) + [0.02, -0.01]
    names = [("firm", "soft")[k] for k in under]
    assert names == [surface_at(floor, float(x), float(y)) for x, y in turned]
    assert len(set(names)) == 2


def test_a_map_may_show_a_floor_that_the_fit_does_not_know(deployed):
    floor = four_zones(["firm", "ice", "firm", "soft"], middle=(0.0, 0.0))
    lookup = floor_of(floor, deployed.labels)
    counted = np.asarray(lookup.cells)
    assert (counted == -1).sum() == (floor.cells == floor.surfaces.index("ice")).sum() > 0
    row, column = np.round(np.argwhere(counted == -1).mean(axis=0)).astype(int)
    x, y = np.asarray(lookup.corner) + (np.array([column, row]) + 0.5) * float(lookup.cell)
    here = jnp.array([x, y, 0.0])
    hypotheses = hypotheses_of(deployed).under
    inside = lookup.under(here, deployed.places)
    supports = lookup.supports(here, jnp.zeros((3, 3)), deployed.places, hypotheses, 2)
    assert bool(jnp.all(inside == -1))
    np.testing.assert_allclose(supports, supports[0, 0])  # it says nothing of any hypothesis


@pytest.mark.slow
def test_the_twin_is_another_robot_of_the_posterior_for_every_start():
    robot = build(omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0), ["firm", "soft"])
    eight = jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * 8), robot)
    frictions = jnp.linspace(0.3, 0.9, 8)[:, None] * jnp.ones(2)
    several = eqx.tree_at(lambda r: r.surfaces.friction, eight, frictions)
    known = deploy_known(robot, draws=several, highest_speed=7.5)
    found = {float(drawn_robot(known, seed).floors.friction[0]) for seed in range(12)}
    assert len(found) > 3
    assert drawn_robot(known, 3).floors.friction[0] == drawn_robot(known, 3).floors.friction[0]


def test_impossible_trials_are_refused(tmp_path, deployed, pair):
    with pytest.raises(DataError, match="expected testsite or twin"):
        tr._tasks(tmp_path, tr.TrialOptions(plant="moon"))
    for rest in (-1.0, 61.0, float("nan")):
        with pytest.raises(DataError, match="s; expected 0 to 60 s"):
            tr._tasks(tmp_path, tr.TrialOptions(rest=rest))
    with pytest.raises(DataError, match="no controller 'magic'; expected one of encoder"):
        tr._tasks(tmp_path, tr.TrialOptions(controllers=("magic",)))
    with pytest.raises(DataError, match="has no surface 'gray'; it has firm"):
        refuse_unknown_to_site(Site(), uniform("gray"), deployed)
    far = replace(deployed, load_setup="far")
    with pytest.raises(DataError, match="no load set-up 'far'; it has as_built"):
        refuse_unknown_to_site(Site(), uniform("firm"), far)
    with pytest.raises(DataError, match="no controller; expected one of encoder"):
        tr._tasks(tmp_path, tr.TrialOptions(controllers=tr.controller_names(",")))
    assert tr.controller_names("contact, encoder,contact") == ("contact", "encoder")
    with pytest.raises(
        DataError, match="no path 'square' for this robot; expected one of rectangle, circle"
    ):
        path_of("square", 0.2, deployed)
    for speed in (0.0, 0.31, float("nan")):
        with pytest.raises(DataError, match=r"expected a speed above 0 and at most 0\.3 m/s"):
            path_of("circle", speed, deployed)
    with pytest.raises(DataError, match=r"at most 0\.5 m/s, the robot's limit"):
        path_of("circle", 0.6, pair)
    with pytest.raises(DataError, match=r"'turning' for this robot; expected .*, clothoid$"):
        path_of("turning", 0.2, pair)
    np.testing.assert_allclose(path_of("rectangle", 0.2, pair).corners[0], [1.35, 0.0])
    assert float(jnp.abs(path_of("rectangle", 0.2, pair).rows[:, 5]).max()) < 0.2 / 0.18
    np.testing.assert_array_equal(path_of("circle", 0.2, deployed).rows[:, 2], 0.0)
    assert path_of("circle", 0.3, deployed).duration < path_of("circle", 0.1, deployed).duration
    with pytest.raises(DataError, match=r"robot\.json: missing; write it by `slipid identify`"):
        tr._tasks(tmp_path, tr.TrialOptions())


def test_the_site_has_the_robot_of_a_config(deployed):
    firm = uniform("firm")
    config = CONFIGS / "testsite_skid.toml"
    site, shape = plan(config, text_of(config)).site, (0.131, 0.187, 0.098)
    skid, motors, other = (
        deploy_known(build(skid_steer(*sizes, drive_of=drive_of), ["firm"]))
        for sizes, drive_of in (
            (shape, (0, 1, 0, 1)),
            (shape, ()),
            ((0.2, 0.187, 0.098), (0, 1, 0, 1)),
        )
    )
    refuse_unknown_to_site(Site(), firm, deployed)
    refuse_unknown_to_site(site, firm, skid)
    for there, robot in ((Site(), skid), (site, motors), (site, other), (site, deployed)):
        with pytest.raises(DataError, match=r"by --site, such as --site configs/testsite_skid"):
            refuse_unknown_to_site(there, firm, robot)
    plant = SitePlant(site, firm, "as_built", (0.0, 0.0, 0.0), 1)
    for _ in range(20):
        reading = plant.step(np.array([2.0, 2.0]))
    assert reading.wheel_angle.shape == reading.current.shape == (2,)
    assert np.ptp(np.asarray(reading.wheel_angle)) < 0.02
    assert plant.pose[0] > 0.1
    assert np.isfinite(reading.gyro)  # as in its config


def test_rows_that_suit_a_robot_without_sideways_motion():
    skid = deploy_known(build(skid_steer(0.13, 0.19, 0.1, drive_of=(0, 1, 0, 1)), ["firm"]))
    kept = applicable(tuple(ROWS), skid)
    rows = ("encoder", "contact", "contact_hand", "contact_map", "contact_gyro", "true_pose")
    assert kept == rows
    for name in ("slip_odometry", "torque", "indiveri", "goswami_padhy"):
        with pytest.raises(DataError, match=f"{name}: only for robots .* one of encoder, contact"):
            applicable((name,), skid)
        with pytest.raises(DataError, match="expected another controller"):
            control_loop_of(skid, ROWS[name])
    with pytest.raises(DataError, match=r"calibrated: robot\.json has no calibration"):
        applicable(("calibrated",), skid)


def test_odometry_rolls_by_the_lengths_of_its_row():
    """Nominal lengths, the mean of calibrated ones over floors, and wheel speeds that undo them."""
    known = deploy_known(build(differential(0.2, 0.1), ["firm", "soft"]), highest_speed=20.0)
    nominal = ((0.05, 0.05), (0.0, 0.0), (-0.25, 0.25))
    firm, soft = (((0.05 * k, 0.05 * k), (0.01, -0.01), (-0.2 * k, 0.2 * k)) for k in (0.9, 0.7))
    floors = [
        replace(floor, calibration=rows)
        for floor, rows in zip(known.record.floors, (firm, soft), strict=True)
    ]
    robot = DeployedRobot.of(replace(known.record, floors=tuple(floors), nominal=nominal))
    assert "calibrated" in applicable(tuple(ROWS), robot)
    for name, ahead, turn in (("encoder", 0.05, 0.25), ("calibrated", 0.04, 0.16)):
        loop = control_loop_of(robot, ROWS[name])
        odometry, state = loop.estimator, loop.estimator.init()
        for k in range(60):
            angle = 0.05 * k * np.array([1.0, 2.0])
            state, seen = odometry.step(state, Measurement(wheel_angle=angle), 0.05)
        np.testing.assert_allclose(seen.twist[jnp.array([0, 2])], [3 * ahead, turn], rtol=1e-6)
        asked, pursues = jnp.array([0.3, 0.0, 0.4]), jnp.zeros((), bool)
        wheels = loop.controller._wheel_speeds(asked, seen, pursues)
        left, right = 0.15 / ahead - 0.2 / turn, 0.15 / ahead + 0.2 / turn
        np.testing.assert_allclose(wheels, [left, right], rtol=1e-6)


def test_a_robot_that_is_told_its_true_pose(deployed):
    plant = TruePosePlant(Unicycle(deployed, (0.3, -0.2, 0.5)))
    assert isinstance(plant, closed_loop.Plant)
    reading = plant.reset()
    np.testing.assert_allclose(reading.fix, (0.3, -0.2, 0.5))
    for _ in range(30):
        reading = plant.step(np.full(3, 2.0))
    np.testing.assert_allclose(reading.fix, plant.pose)
    assert plant.pose[2] > 0.6
    filled = reading.filled(3)
    assert (filled.fix_std < 0.002).all()
    assert float(filled.fix_age) == 0.0
    assert np.isnan(plant.power)


@pytest.mark.slow
def test_runs_of_another_path_or_speed_are_driven_anew(tmp_path, deployed):
    deployed.save(tmp_path / "robot.json")

    def jobs(**wish):
        return tr._tasks(tmp_path, tr.TrialOptions(plant="twin", controllers=("encoder",), **wish))

    plain = jobs()[0]
    np.testing.assert_array_equal(plain.path.rows, reference.rectangle().rows)
    assert signature(command).parameters["rest"].default == tr.TrialOptions().rest
    for other in ({"path": "turning"}, {"speed": 0.1}, {"rest": 2.0}):
        job = jobs(**other)[0]
        expected = reference.PATHS[other.get("path", "rectangle")](other.get("speed", 0.2))
        np.testing.assert_array_equal(job.path.rows, expected.rows)
        job.kept.save_json("mark", {})
        assert plain.kept.load_json("mark") is None
        assert jobs(**other)[0].kept.load_json("mark") == {}


def test_a_controller_can_have_another_map_than_the_true_one(tmp_path, deployed, monkeypatch):
    deployed.save(tmp_path / "robot.json")
    labels = list(deployed.labels)
    maps = {"true": labels[:2], "told": labels[1::-1], "strange": [labels[0], "moss"]}
    for name, (a, b) in maps.items():
        colours = {a: "#101010", b: "#f0f0f0"}
        write_map(tmp_path / f"{name}.toml", four_zones([a, b, a, b]), colours)

    def jobs(**more):
        wish = {"plant": "twin", "controllers": ("contact_map",), "map": tmp_path / "true.toml"}
        return tr._tasks(tmp_path, tr.TrialOptions(**wish, **more))

    plain, other = jobs()[0], jobs(told_map=tmp_path / "told.toml")[0]
    assert plain.known_map is plain.floor
    assert other.kept.folder != plain.kept.folder
    middle = np.array([[0.0, 0.5], [0.9, 0.5]])

    def named(floor):
        return [floor.surfaces[int(k)] for k in floor.at(middle)]

    assert named(other.floor) == named(plain.floor) == labels[:2]
    assert named(other.known_map) == labels[1::-1]

    class Told(Exception):
        pass

    def caught(robot, row, settings, floor, recovery):
        raise Told(floor)

    monkeypatch.setattr(tr, "control_loop_of", caught)
    with pytest.raises(Told) as told:
        tr.drive(other)
    (floor,) = told.value.args
    for k, place in enumerate(middle):
        under = floor.under(jnp.array([*place, 0.0]), jnp.zeros((1, 2)))
        assert labels[int(under[0])] == labels[1 - k]
    rested = []
    monkeypatch.setattr(reference.Path, "after_rest", lambda path, s: rested.append(s) or path)
    with pytest.raises(Told):
        tr.drive(jobs(rest=2.0)[0])
    assert rested == [2.0]
    with pytest.raises(DataError, match=r"strange\.toml: surface 'moss' was not identified"):
        jobs(told_map=tmp_path / "strange.toml")


def values(gains):
    return [float(x) for x in jax.tree.leaves(gains)]


def run_of(name, k, closure, finished=True, recoveries=0, freed=0):
    """A run whose numbers follow from its closure."""
    metrics = closed_loop.PathMetrics(
        along_track_mm=(-90.0 * (1 + 0.1 * k), 0.0, 0.0, 0.0),
        sides_mm=(900.0, 400.0, 900.0, 400.0),
        closure_mm=closure,
        cross_track_rmse_mm=closure / 2,
        heading_error_deg=-3.0,
        path_length_mm=2500.0,
        energy_j=None if name == "contact" else 10.0,
        effort=0.1,
        seconds=19.0,
        finished=finished,
        recoveries=recoveries,
        freed=freed,
    )
    return TrialRun(name, (0.0, 0.0, 0.1), k, metrics, 1.0)


def test_the_best_controller_follows_from_differences_over_the_same_starts():
    rng = np.random.default_rng(0)
    base = rng.uniform(50, 500, 20)  # starts differ by far more than controllers do

    def runs(name, closures, finished=True):
        return [run_of(name, k, float(c), finished) for k, c in enumerate(closures)]

    one, two = runs("encoder", base), runs("contact", 0.8 * base)
    assert best_controllers(one + two) == ("contact",)
    same = runs("contact", base * rng.uniform(0.7, 1.25, 20))
    assert set(best_controllers(one + same)) == {"encoder", "contact"}
    # one that leaves a run unfinished does not close best, however near it comes
    stuck = [*two[:-1], run_of("contact", 19, 1.0, finished=False)]
    assert best_controllers(one + stuck) == ("encoder",)
    assert best_controllers(one) == ("encoder",)


def test_the_verdict_names_what_the_best_controllers_need():
    rng = np.random.default_rng(0)
    base = rng.uniform(50, 500, 20)
    needs = {name: ROWS[name].needs for name in ROWS}

    def said(gyro=False, **factors):
        pairs = ((n, f * np.ones(20) if np.isscalar(f) else f) for n, f in factors.items())
        runs = [run_of(n, k, float(c)) for n, f in pairs for k, c in enumerate(f * base)]
        return verdict(runs, needs, gyro)

    noise = rng.uniform(0.7, 1.25, 20)
    rows = {"encoder": 2.0, "calibrated": 1.0, "contact": noise, "contact_gyro": 0.2}
    better = np.median(noise * base) < np.median(base)
    first, second = ("contact", "calibrated") if better else ("calibrated", "contact")
    assert said(**rows) == (
        "closes best: contact_gyro (with a gyro, which your logs do not have); without a gyro: "
        f"{first}, not distinguished from {second}"
    )
    assert said(True, **rows).startswith("closes best: contact_gyro (with a gyro); without")
    assert said(encoder=1.0, contact=0.5) == "closes best: contact"
    assert said(encoder=1.0, contact_map=0.2, contact_gyro=0.4) == (
        "closes best: contact_map (with a map of the floors); without a map of the floors: "
        "contact_gyro (with a gyro, which your logs do not have); without a map of the floors and "
        "without a gyro: encoder"
    )
    assert said(contact_gyro=1.0) == (
        "closes best: contact_gyro (with a gyro, which your logs do not have)"
    )


def test_differences_to_calibrated_odometry_and_recoveries_are_summarised():
    base = np.linspace(100.0, 119.0, 20)
    runs = [run_of("calibrated", k, c) for k, c in enumerate(base)]
    apart = np.where(np.arange(20) % 2, -10.0, -30.0)
    tried = [(0, 0)] * 12 + [(2, 2)] * 6 + [(2, 1)] * 2
    runs += [
        run_of("contact", k, c, recoveries=tries, freed=freed)
        for k, (c, (tries, freed)) in enumerate(zip(base + apart, tried, strict=True))
    ]
    found = summaries(runs)
    told = found["contact"]["to_calibrated"]
    assert told["mean_difference_mm"] == pytest.approx(-20.0)
    assert told["standard_error_mm"] == pytest.approx(10.0 / np.sqrt(19))
    assert found["calibrated"]["to_calibrated"]["mean_difference_mm"] == 0.0
    assert found["contact"]["recovery_share"] == 0.4
    assert found["contact"]["freed_share"] == 0.75
    assert found["calibrated"]["recovery_share"] == 0.0
    assert found["calibrated"]["freed_share"] is None


def test_the_summary_is_of_medians_over_starts_with_intervals():
    rng = np.random.default_rng(0)

    def run(name, k, closure):
        made = run_of(name, k, closure)
        assert typed(TrialRun, json.loads(json.dumps(asdict(made)))) == made
        return made

    base = rng.uniform(100, 200, 20)
    runs = [run("encoder", k, b) for k, b in enumerate(base)]
    runs += [run("contact", k, 0.4 * b) for k, b in enumerate(base)]
    found = summaries(runs)
    assert found["encoder"]["closure_error_median"] == pytest.approx(np.median(base))
    assert found["encoder"]["heading_error_deg"] == 3.0
    assert "energy_j" in found["encoder"]
    assert "energy_j" not in found["contact"]
    assert (found["encoder"]["worse_share"], found["contact"]["worse_share"]) == (0.0, 0.0)
    worse = [run("contact", k, b + (-1.0 if k < 15 else 1.0)) for k, b in enumerate(base)]
    assert summaries(runs[:20] + worse)["contact"]["worse_share"] == pytest.approx(0.25)
    ratio = found["contact"]["to_encoder"]["closure_error_median"]
    assert ratio["value"] == pytest.approx(0.4)
    assert ratio["interval90"] == pytest.approx([0.4, 0.4])
    low, high = found["encoder"]["interval90"]["closure_error_median"]
    assert low < np.median(base) < high
    few = summaries([run for run in runs if run.seed < 4])["contact"]
    assert few["runs"] == 4
    assert few["interval90"]["closure_error_median"] is None
    assert few["to_encoder"]["closure_error_median"]["interval90"] is None


def test_live_readings_are_as_the_sensors_log_them():
    live = SitePlant(Site(), uniform("firm"), "as_built", (0.0, 0.0, 0.0), 1)
    forward = live.plant.robot.wheel_from_twist @ np.array([0.2, 0.0, 0.0])
    for _ in range(20):
        reading = live.step(forward)
    tick = 2 * np.pi / (2000 * 16)
    np.testing.assert_allclose(
        reading.wheel_angle / tick, np.round(reading.wheel_angle / tick), atol=1e-6
    )
    assert (reading.current >= 0).all()  # magnitudes
    assert np.isnan(reading.gyro)
    assert live.plant.time == pytest.approx(20 * PERIOD)
    assert live.pose[0] > 0.1  # a delay and a slew, then 0.2 m/s


@pytest.mark.slow
def test_a_plant_that_is_reset_starts_anew():
    plant = SitePlant(GYRO_SITE, uniform("firm"), "as_built", (0.2, 0.1, 0.3), 1)
    first = jax.tree.leaves(plant.reset())
    begin = plant.pose
    for _ in range(10):
        plant.step(np.full(3, 3.0))
    assert plant.pose != begin
    np.testing.assert_array_equal(np.hstack(jax.tree.leaves(plant.reset())), np.hstack(first))
    assert plant.pose == begin
