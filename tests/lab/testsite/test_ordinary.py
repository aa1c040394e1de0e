"""Ordinary wheels on the test site: differential robots with a castor ball, and skid steering."""

import json
from dataclasses import replace

import numpy as np
import pytest

from slipid.app.config import geometry, parsed
from slipid.data.floor_map import uniform
from slipid.data.reading.presets import declared_layout
from slipid.lab.testsite.config import identify_config, plan
from slipid.lab.testsite.contacts import POINTS
from slipid.lab.testsite.driving import SiteRun, TimedTwists, Trace, Waypoints, drive, straight
from slipid.lab.testsite.kinematics import effective_kinematics
from slipid.lab.testsite.motors import MotorBuild, SpeedLoop
from slipid.lab.testsite.ordinary_build import OrdinaryBuild
from slipid.lab.testsite.plant import SimulatedRobot
from slipid.lab.testsite.sections import ArcRuns, PathRuns, SpinRuns
from slipid.lab.testsite.simulate import log_of, simulate, truth
from slipid.lab.testsite.site import Site, SiteSensors
from slipid.lab.testsite.surfaces import GRAVITY, SURFACES
from slipid.support.errors import DataError
from slipid.support.executor import InProcess
from slipid.support.progress import Reporter
from tests.conftest import ROOT
from tests.helpers.one_log import read_log

mujoco = pytest.importorskip(
    "mujoco", reason="the test site needs slipid[testsite], which the development environment has"
)

SKID = OrdinaryBuild(
    drive="skid",
    wheelbase_m=0.26,
    track_m=0.38,
    wheel_radius_m=0.1,
    wheel_width_m=0.04,
    wheel_mass_kg=0.5,
    mass_kg=17.0,
    gear_ratio=34.0,
    centres_m={"as_built": (0.0, 0.0)},
    marker_height_m=0.4,
)
DIFFERENTIAL = OrdinaryBuild(
    drive="differential",
    castor_m=(-0.2, 0.0),
    track_m=0.33,
    wheel_radius_m=0.08,
    wheel_mass_kg=0.4,
    mass_kg=9.0,
    gear_ratio=34.0,
    centres_m={"as_built": (-0.05, 0.0)},
    marker_height_m=0.3,
)
BOTH = pytest.mark.parametrize("robot", [SKID, DIFFERENTIAL], ids=["skid", "differential"])
MOTOR = MotorBuild(
    resistance_ohm=0.7, inductance_h=2e-4, back_emf_vs=0.045, coulomb_nm=0.15, viscous_nms=0.01
)
EVEN = {name: replace(g, unevenness=0.0) for name, g in SURFACES.items()}


def site(robot: OrdinaryBuild, **more) -> Site:
    return Site(robot, MOTOR, SpeedLoop(gain=0.1, integral=2.0), surfaces=EVEN, **more)


def standing(robot: OrdinaryBuild, surface: str) -> SimulatedRobot:
    return SimulatedRobot(site(robot), uniform(surface), "as_built")


def driven(run: SiteRun, robot: OrdinaryBuild, step: float = 1e-3) -> Trace:
    return drive(run, site(robot), 0, step)


def pushed(plant: SimulatedRobot, force: float, axis: int, speed: float, steps: int) -> None:
    """Push the body along x (0) or y (1), while its wheels are commanded a speed [rad/s]."""
    for _ in range(steps):
        plant.data.qfrc_applied[axis] = force
        plant.step([speed] * len(plant.wheel_dof))


# the engine


@BOTH
def test_the_floor_carries_the_weight_once(robot):
    plant = standing(robot, "medium")
    wheels = len(robot.places)
    castors = len(robot.supports) - wheels
    assert len(plant.data.contact) == POINTS * wheels + castors
    force, carried = np.zeros(6), np.zeros(len(robot.supports))
    for k, contact in enumerate(plant.data.contact):
        mujoco.mj_contactForce(plant.model, plant.data, k, force)
        name = plant.model.geom(max(contact.geom)).name
        carried[-1 if name == "castor" else int(name[-1])] += force[0]
    weight = robot.mass_kg * GRAVITY
    np.testing.assert_allclose(carried / weight, robot.support_share("as_built"), atol=0.01)
    # a wheel that carries a third of the robot sinks in by the floor's softness
    z = robot.radii - plant.data.xpos[plant.wheel_body, 2]
    np.testing.assert_allclose(
        z, 3 * carried[:wheels] / weight * EVEN["medium"].softness_m, rtol=0.1
    )


def test_friction_holds_a_push_from_the_side_up_to_its_limit():
    limit = EVEN["firm"].friction * SKID.mass_kg * GRAVITY
    plant = standing(SKID, "firm")
    pushed(plant, 0.8 * limit, 1, 0.0, 300)
    assert abs(plant.data.qvel[1]) < 0.005
    before = plant.data.qvel[1]
    pushed(plant, 1.5 * limit, 1, 0.0, 200)
    gained = (plant.data.qvel[1] - before) / 0.2
    assert gained == pytest.approx(0.5 * limit / SKID.mass_kg, rel=0.1)


@BOTH
def test_a_coasting_robot_only_loses_energy(robot):
    plant = standing(robot, "medium")
    plant.model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    rims = robot.wheel_from_twist @ np.array([0.4, 0.0, 0.5])
    for _ in range(800):
        plant.step(rims.tolist())
    plant.drive.step = lambda wanted, angle, speed: [0.0] * len(wanted)
    total = []
    for _ in range(300):
        plant.step([0.0] * len(rims))
        total.append(float(plant.data.energy.sum()))
    assert total[0] - total[-1] > 0.1
    assert np.diff(total).max() < 1e-3


def test_a_floor_that_yields_under_shear_lets_rolling_wheels_creep_under_a_force():
    """The share of the rim speed that is lost to a force F is F over the sum of k l."""
    ground = replace(EVEN["soft"], rolling_m=0.0, compaction=0.0, body_drag_n=0.0)
    force, found = 20.0, []
    for push in (0.0, -force):
        plant = SimulatedRobot(
            replace(site(SKID), surfaces={"soft": ground}), uniform("soft"), "as_built"
        )
        pushed(plant, push, 0, 4.0, 1000)
        x, angle = plant.pose[0], plant.wheel_angle.mean()
        pushed(plant, push, 0, 4.0, 500)
        found.append((plant.pose[0] - x) / (plant.wheel_angle.mean() - angle))
    sinkage = np.maximum(SKID.radii - plant.data.xpos[plant.wheel_body, 2], 0)
    stiffness = (ground.shear_n_m * 2 * np.sqrt(2 * SKID.radii * sinkage)).sum()
    assert (found[0] - found[1]) / SKID.wheel_radius_m == pytest.approx(force / stiffness, rel=0.1)


def test_wheels_that_share_a_motor_turn_together():
    plant = standing(SKID, "medium")
    for _ in range(600):
        plant.step((SKID.wheel_from_twist @ np.array([0.2, 0.0, 0.8])).tolist())
    left, right, *rear = [float(plant.data.joint(f"wheel{k}").qpos[0]) for k in range(4)]
    assert abs(right - left) > 0.5
    np.testing.assert_allclose(rear, [left, right], atol=1e-3)
    assert len(plant.wheel_angle) == 2


# motion


@BOTH
def test_a_robot_that_drives_straight_goes_as_far_as_its_wheels_roll(robot):
    trace = driven(straight("firm", "as_built", 0.0, 0.4, 0.8), robot)
    far = np.hypot(*(trace.pose[-1, :2] - trace.pose[0, :2]))
    rolled = robot.wheel_radius_m * (trace.wheel_angle[-1] - trace.wheel_angle[0])
    np.testing.assert_allclose(rolled, far, rtol=0.01)
    assert abs(trace.pose[-1, 2]) < 0.01
    backward = driven(straight("firm", "as_built", np.pi, 0.4, 0.4), robot)
    assert backward.pose[-1, 0] - backward.pose[0, 0] == pytest.approx(-0.4, abs=0.1)


def test_a_skid_that_turns_on_the_spot_needs_a_wider_track_than_it_has():
    """Four equally loaded wheels slide without a moment at an effective track b (1 + (a / b)^2).

    a is the wheelbase, b the track, and friction is equal ahead and sideways.
    """
    run = straight("firm", "as_built", 0.0, 0.0, 0.25, 1.0)
    trace = driven(run, SKID)
    track = 0.1 * np.ptp(trace.wheel_angle, axis=0).sum() / np.ptp(trace.pose[:, 2])
    assert track > 1.3 * SKID.track_m
    assert track == pytest.approx(SKID.track_m * (1 + (0.26 / 0.38) ** 2), rel=0.04)
    # two narrow wheels on one axle do not scrub
    trace = driven(run, replace(DIFFERENTIAL, wheel_width_m=0.004))
    track = 0.08 * np.ptp(trace.wheel_angle, axis=0).sum() / np.ptp(trace.pose[:, 2])
    assert track == pytest.approx(DIFFERENTIAL.track_m, rel=0.02)


def test_a_skid_of_equal_halves_turns_about_its_middle_on_a_soft_floor():
    """Friction that resisted accelerations would push it outwards in a curve."""
    run = straight("soft", "as_built", 0.0, 0.4, 0.6, 0.4)
    trace = driven(run, SKID)
    found = effective_kinematics(SKID, [(run, trace.pose[::10], trace.wheel_angle[::10])])
    assert abs(found["as_built"]["soft"]["arcs"]["centre_of_rotation_m"]) < 0.02


@pytest.mark.slow
@BOTH
def test_half_the_time_step_ends_at_the_same_place(robot):
    run = straight("soft", "as_built", 0.0, 0.3, 0.6, 0.4)
    ends = [driven(run, robot, step).pose[-1] for step in (1e-3, 5e-4)]
    assert np.hypot(*(ends[0] - ends[1])[:2]) < 0.01 * 0.6
    assert abs(ends[0][2] - ends[1][2]) < 0.01


def test_a_larger_wheel_makes_a_robot_turn_to_the_other_side():
    robot = replace(DIFFERENTIAL, radius_error=(0.02, 0.0))
    trace = driven(straight("firm", "as_built", 0.0, 0.4, 0.6), robot)
    angle = np.ptp(trace.wheel_angle, axis=0).mean()
    assert trace.pose[-1, 2] == pytest.approx(-0.02 * 0.08 * angle / 0.33, rel=0.15)


def test_way_points_are_reached_by_turning_towards_them():
    places = ((0.25, 0.0), (0.25, 0.25))
    run = SiteRun(None, "as_built", Waypoints(places, 0.6, "camera"), floor=uniform("firm"))
    trace = driven(run, DIFFERENTIAL)
    for place in places:
        assert np.hypot(*(trace.pose[:, :2] - place).T).min() < 0.03
    assert trace.pose[-1, 2] > 0.8
    assert not trace.twist_command[:, 1].any()


def test_the_same_seed_gives_the_same_log():
    run = straight("soft", "as_built", 0.0, 0.4, 0.1, 0.4)
    logs = [
        log_of(drive(run, Site(SKID, MOTOR), seed), site(SKID), run, "x", seed)
        for seed in (1, 1, 2)
    ]
    np.testing.assert_array_equal(logs[0].pose, logs[1].pose)
    assert logs[0].sha256 == logs[1].sha256 != logs[2].sha256


def test_the_logged_pose_is_that_of_the_marker():
    robot = replace(DIFFERENTIAL, marker_place_m=(0.1, -0.05), marker_yaw_deg=0.0)
    still = np.zeros((500, 2))
    time = 1e-3 * np.arange(500)
    pose = np.broadcast_to([1.0, 2.0, 0.5 * np.pi], (500, 3))
    electric = {"current": still, "voltage": still, "bus": time + 24.0, "sinkage": still}
    trace = Trace(
        time, pose, 0 * time, still, still, still, **electric, twist_command=np.zeros((500, 3))
    )
    exact = SiteSensors(camera_noise_m=0.0, camera_noise_rad=0.0, camera_scale=1.0, outlier=0.0)
    run = straight("firm", "as_built", 0.0, 0.1, 0.1)
    log = log_of(trace, site(robot, sensors=exact), run, "x", 0)
    np.testing.assert_allclose(log.pose, np.broadcast_to([1.05, 2.1, 0.5 * np.pi], log.pose.shape))
    assert truth(site(robot))["camera.marker_place"] == {"value": [0.1, -0.05], "unit": "m"}


def test_effective_kinematics_are_those_that_the_motion_has():
    """Motion that follows known radii, a known track and a known centre of rotation exactly."""
    radii, track, centre = np.array([0.081, 0.078]), 0.36, -0.02
    motions = []
    for run in (
        *ArcRuns(surface="firm", curvatures_1_m=[0.0, 0.6, -0.6], speeds_m_s=[0.3, -0.3]).runs(),
        *SpinRuns(surface="firm").runs(),
        *PathRuns(surface="firm", count=2).runs(),
        replace(ArcRuns(surface="soft").runs()[0], surface=None, place="map"),
    ):
        parts = [np.tile(twist, (round(100 * s), 1)) for twist, s in run.program.legs]
        speeds = DIFFERENTIAL.wheel_from_twist @ np.concatenate(parts).T
        rim = radii[:, None] * speeds
        ahead, turn = rim.mean(axis=0), (rim[1] - rim[0]) / track
        heading = np.concatenate([[0.0], np.cumsum(0.01 * turn)])
        c, s = np.cos(heading[:-1] + 0.005 * turn), np.sin(heading[:-1] + 0.005 * turn)
        left = -centre * turn
        x, y = np.cumsum(0.01 * (c * ahead - s * left)), np.cumsum(0.01 * (s * ahead + c * left))
        pose = np.stack([np.append(0.0, x), np.append(0.0, y), heading], axis=1)
        motions.append((run, pose, np.append(np.zeros((1, 2)), np.cumsum(0.01 * speeds.T, 0), 0)))
    found = effective_kinematics(DIFFERENTIAL, motions)
    assert found.keys() == {"as_built"}
    assert found["as_built"].keys() == {"firm"}
    firm = found["as_built"]["firm"]
    np.testing.assert_allclose(firm["rolling_radius_m"], radii, rtol=1e-6)
    for kind in ("on_the_spot", "arcs"):
        assert firm[kind]["effective_track_m"] == pytest.approx(track, rel=1e-6)
        assert firm[kind]["centre_of_rotation_m"] == pytest.approx(centre, rel=1e-6)


# configs and files

SMALL = """
[robot]
drive = "skid"
track_m = 0.38
wheelbase_m = 0.26
wheel_radius_m = 0.1
mass_kg = 17.0
gear_ratio = 34.0
centres_m = { as_built = [0.0, 0.0] }
marker_height_m = 0.4
[motor]
resistance_ohm = 0.7
back_emf_vs = 0.045
[sensors]
camera_scale = 1.0
[[runs]]
kind = "arcs"
surface = "firm"
curvatures_1_m = [0.0]
speeds_m_s = [0.5]
distance_m = 0.3
[[runs]]
kind = "spins"
surface = "firm"
rates_deg_s = [90]
angle_deg = 60
"""


def test_a_simulation_writes_logs_that_its_config_reads_and_the_kinematics_apart(tmp_path):
    made = plan(tmp_path / "site.toml", SMALL)
    with Reporter(quiet=True) as report:
        simulate(made, tmp_path, InProcess(), report)
    found = json.loads((tmp_path / "truth/kinematics.json").read_text())
    firm = found["load_setups"]["as_built"]["firm"]
    assert firm["on_the_spot"]["effective_track_m"] > 1.3 * 0.38
    np.testing.assert_allclose(firm["rolling_radius_m"], 0.1, rtol=0.02)
    config = parsed(tmp_path / "robot.toml", (tmp_path / "robot.toml").read_text()).content
    layout = declared_layout(config.layouts["testsite"], "testsite")
    path = tmp_path / "logs/as_built/firm/run001.csv"
    log = read_log(path, layout, root=tmp_path / "logs", surface="firm")
    assert log.wheels == 2
    with np.load(tmp_path / "truth/as_built/firm/run001.npz") as true:
        assert true["sinkage"].shape[1] == 4
        angle = [np.interp(log.time[-1], true["time"], a) for a in true["wheel_angle"].T]
        np.testing.assert_allclose(log.wheel_angle[-1], angle, atol=0.01)


@pytest.mark.parametrize("name", ["skid", "differential"])
def test_the_config_for_a_fit_describes_the_simulated_robot(name):
    path = ROOT / "configs" / f"testsite_{name}.toml"
    made = plan(path, path.read_text())
    config = parsed(path.with_name("robot.toml"), identify_config(made))
    wheels = geometry(config.content.robot)
    robot = made.site.robot
    places = np.asarray(wheels.place) * np.asarray(wheels.base_radius)
    np.testing.assert_allclose(places, robot.places, atol=1e-12)
    assert wheels.drives == robot.drives == 2
    assert config.content.robot.wheel_radius_m == robot.wheel_radius_m
    place = config.content.parameters["camera.marker_place"].prior
    assert (place.mean, place.std) == ([0.0, 0.0], 0.1)


def test_a_motor_for_each_wheel_is_a_drive_for_each_wheel(tmp_path):
    made = plan(tmp_path / "x.toml", SMALL.replace("[motor]", 'motors = "wheel"\n[motor]'))
    config = parsed(tmp_path / "robot.toml", identify_config(made)).content
    assert geometry(config.robot).drives == made.site.robot.drives == 4
    assert len(config.layouts["testsite"]["columns"]["current"]["columns"]) == 4


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (('kind = "spins"', 'kind = "headings"'), "rates_deg_s: no such key"),
        (
            (
                'kind = "spins"\nsurface = "firm"\nrates_deg_s = [90]\nangle_deg = 60',
                'kind = "headings"\nsurface = "firm"',
            ),
            r"runs\[2\].kind: 'headings' drives sideways, which a skid robot cannot; expected one",
        ),
        (("[90]", "[0]"), r"runs\[2\].rates_deg_s\[1\]: 0; expected"),
        (("[0.5]", "[0.0]"), r"runs\[1\].speeds_m_s\[1\]: 0.0; expected"),
        (("wheelbase_m = 0.26\n", ""), "robot: wheelbase_m with drive = 'skid'; expected this key"),
        (("track_m", "castor_m = [-0.2, 0]\ntrack_m"), "castor_m with drive = 'skid'; only diff"),
        (("0.0, 0.0] }", "0.2, 0.0] }"), "centres_m.as_built: the centre of mass"),
        (
            ('"skid"', '"tracked"'),
            r"robot.drive: 'tracked'; expected one of omni, differential, skid",
        ),
        (("track_m", "trak_m"), "robot.trak_m: no such key, did you mean track_m"),
    ],
)
def test_mistakes_are_named_with_their_key(tmp_path, change, match):
    text = SMALL.replace(*change)
    assert text != SMALL
    with pytest.raises(DataError, match=match):
        plan(tmp_path / "site.toml", text)


def test_paths_have_turns_on_the_spot_and_two_speeds():
    runs = PathRuns(surface="firm", count=8, seed=3).runs()
    twists = [twist for run in runs for twist, _ in run.program.legs[:-1]]
    assert {ahead for ahead, *_ in twists} == {0.0, 0.2, 0.4}
    assert len({turn for *_, turn in twists}) == len(twists) == 32
    assert runs == PathRuns(surface="firm", count=8, seed=3).runs()
    assert runs != PathRuns(surface="firm", count=8, seed=4).runs()
    assert isinstance(runs[0].program, TimedTwists)
