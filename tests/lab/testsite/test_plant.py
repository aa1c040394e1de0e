"""Physics of the virtual test site that holds for any contact law."""

from dataclasses import replace
from unittest.mock import Mock

import mujoco
import numpy as np
import pytest

from slipid.data.floor_map import FloorMap, four_zones, uniform
from slipid.lab.testsite.driving import (
    SiteRun,
    TimedTwists,
    Trace,
    Waypoints,
    drive,
    named_runs,
    straight,
)
from slipid.lab.testsite.motors import MotorBuild, SpeedLoop, WheelDrives
from slipid.lab.testsite.omni_build import OmniBuild
from slipid.lab.testsite.plant import SimulatedRobot
from slipid.lab.testsite.sections import (
    CurveRuns,
    HeadingRuns,
    PaperGridRuns,
    RectangleRuns,
    WanderRuns,
)
from slipid.lab.testsite.site import Site
from slipid.lab.testsite.surfaces import GRAVITY, LEVELS, SURFACES, SurfacePhysics, ribs
from tests.helpers.floors import surface_at

EVEN = {name: replace(g, unevenness=0.0) for name, g in SURFACES.items()}
CENTRED = replace(OmniBuild(), centres_m={"as_built": (0.0, 0.0)})
STILL = [0.0, 0.0, 0.0]


def standing(
    surface: str, robot: OmniBuild = CENTRED, seed: int = 0, **more: SurfacePhysics
) -> SimulatedRobot:
    grounds = {**EVEN, **more}
    return SimulatedRobot(Site(robot, surfaces=grounds), uniform(surface), "as_built", seed=seed)


def loads(plant: SimulatedRobot) -> np.ndarray:
    """Vertical force of the floor on each wheel at this moment [N]."""
    out, force = np.zeros(len(plant.wheel_dof)), np.zeros(6)
    for k, contact in enumerate(plant.data.contact):
        mujoco.mj_contactForce(plant.model, plant.data, k, force)
        for geom in contact.geom:
            if (name := plant.model.geom(geom).name).startswith("roller"):
                up = contact.frame.reshape(3, 3).T @ force[:3]
                out[int(name.removeprefix("roller").split("_")[0])] += abs(up[2])
    return out


def sixths(surface: str) -> list[SiteRun]:
    """Straight runs 60 degrees apart."""
    plan = HeadingRuns(surface=surface, step_deg=60.0, speeds_m_s=[0.2], distance_m=0.6)
    return plan.runs()


def body_step(trace: Trace) -> np.ndarray:
    """Displacement of a run in the body frame of its start."""
    dx, dy = trace.pose[-1, :2] - trace.pose[0, :2]
    c, s = np.cos(trace.pose[0, 2]), np.sin(trace.pose[0, 2])
    return np.array([c * dx + s * dy, c * dy - s * dx, trace.pose[-1, 2] - trace.pose[0, 2]])


def rolled(trace: Trace, robot: OmniBuild) -> np.ndarray:
    """What the encoders say of it, integrated along the way."""
    steps = np.diff(trace.wheel_angle, axis=0) @ np.linalg.pinv(robot.wheel_from_twist).T
    heading = np.cumsum(steps[:, 2]) - 0.5 * steps[:, 2]
    c, s = np.cos(heading), np.sin(heading)
    x, y = c * steps[:, 0] - s * steps[:, 1], s * steps[:, 0] + c * steps[:, 1]
    return np.array([x.sum(), y.sum(), steps[:, 2].sum()])


def slip(trace: Trace, robot: OmniBuild) -> float:
    far, wheels = body_step(trace)[:2], rolled(trace, robot)[:2]
    return float(1 - np.hypot(*far) / np.hypot(*wheels))


# the engine


@pytest.mark.slow
@pytest.mark.parametrize("surface", ["firm", "soft", "ribbed"])
def test_a_robot_at_rest_gains_no_energy(surface):
    plant = standing(surface)
    plant.model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    energy, total = [], []
    for _ in range(3000):
        plant.step(STILL)
        energy.append(plant.data.energy[1])
        total.append(float(plant.data.energy.sum()))
    # it creeps into the floor for a while, ever more slowly
    assert max(energy[2500:]) < 1e-6
    assert max(energy[2500:]) < 0.1 * max(energy[:500])
    assert total[-1] - total[0] < 1e-6
    assert np.hypot(*plant.pose[:2]) < 0.004


@pytest.mark.parametrize("surface", ["firm", "medium"])
def test_a_coasting_robot_only_loses_energy(surface):
    plant = standing(surface)
    plant.model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    rim = CENTRED.wheel_from_twist @ np.array([0.3, 0.1, 0.0])
    for _ in range(600):
        plant.step(rim.tolist())
    # motors off: no current, no voltage
    plant.drive.step = lambda wanted, angle, speed: [0.0, 0.0, 0.0]
    total = []
    for _ in range(600):
        plant.step(STILL)
        total.append(float(plant.data.energy.sum()))
    total = np.array(total)
    assert total[0] - total[-1] > 0.05
    # springs give back what they hold while rollers change; over 50 ms nothing is gained
    assert np.max(total[50:] - total[:-50]) < 0.01


@pytest.mark.slow
def test_the_floor_carries_the_weight_as_statics_say():
    plant = standing("firm", OmniBuild())
    rim = OmniBuild().wheel_from_twist @ np.array([0.1, 0.05, 0.0])
    found = []
    for _ in range(4000):
        plant.step(rim.tolist())
        found.append(loads(plant))
    weight = OmniBuild().mass_kg * GRAVITY
    mean = np.mean(found[500:], axis=0)
    assert mean.sum() == pytest.approx(weight, rel=0.01)
    # while it stands, where on its two rows of rollers a wheel rests moves a share by up to .02
    np.testing.assert_allclose(mean / weight, OmniBuild().load_share("as_built"), atol=0.012)


@pytest.mark.nightly
def test_a_centred_robot_looks_the_same_from_every_wheel():
    site = Site(robot=CENTRED, surfaces=EVEN)
    ends = []
    for k in range(3):
        way = 0.4 + 2 * np.pi * k / 3
        each = [
            body_step(drive(straight("medium", "as_built", way, 0.2, 0.5), site, seed))
            for seed in range(4)
        ]
        x, y, turn = np.mean(each, axis=0)
        c, s = np.cos(way), np.sin(way)
        ends.append([c * x + s * y, c * y - s * x, turn])
    np.testing.assert_allclose(ends, np.broadcast_to(np.mean(ends, axis=0), (3, 3)), atol=0.008)


@pytest.mark.slow
def test_wheels_roll_where_the_floor_is_firm():
    site = Site()
    back = np.linalg.pinv(site.robot.wheel_from_twist)
    for run in sixths("firm"):
        trace = drive(run, site, 1)
        steady = (trace.time > 1.0) & (trace.time < 2.8)
        wheels = back @ trace.wheel_speed[steady].mean(axis=0)
        t, pose = trace.time[steady], trace.pose[steady]
        speed = np.hypot(*(pose[-1, :2] - pose[0, :2])) / (t[-1] - t[0])
        assert speed == pytest.approx(np.hypot(*wheels[:2]), rel=0.02)
        # and the built-in loop holds the speed that was asked for
        wanted = trace.wheel_command[steady].mean(axis=0)
        np.testing.assert_allclose(trace.wheel_speed[steady].mean(axis=0), wanted, atol=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("surface", ["firm", "soft"])
def test_half_the_time_step_ends_at_the_same_place(surface):
    site = Site()
    for way in (0.5, 2.9):
        run = straight(surface, "as_built", way, 0.2, 0.5)
        ends = [drive(run, site, 2, step).pose[-1, :2] for step in (1e-3, 5e-4)]
        assert np.hypot(*(ends[0] - ends[1])) < 0.02 * 0.5


@pytest.mark.nightly
def test_slip_grows_with_softness_and_depends_on_the_direction():
    site = Site()
    found = {}
    for surface in ("firm", "medium", "soft"):
        runs = sixths(surface)
        found[surface] = [slip(drive(run, site, 3), site.robot) for run in runs]
    assert 0.003 < np.mean(found["firm"]) < 0.03
    assert 0.1 < np.mean(found["medium"]) < 0.3
    assert 0.2 < np.mean(found["soft"]) < 0.55
    assert np.ptp(found["soft"]) > 0.1  # the centre of mass lies off the middle
    level = [slip(drive(run, Site(robot=CENTRED), 3), CENTRED) for run in sixths("soft")]
    assert np.ptp(level) < 0.6 * np.ptp(found["soft"])


@pytest.mark.slow
def test_ribs_shake_a_robot_and_do_not_hold_it():
    site = Site()
    smooth = {**SURFACES, "ribbed": replace(SURFACES["ribbed"], rib_height_m=0.0)}
    run = straight("ribbed", "as_built", 0.0, 0.2, 0.5)
    over, flat = drive(run, site, 0), drive(run, Site(surfaces=smooth), 0)
    assert body_step(over)[0] > 0.4
    shake = [np.std(np.diff(t.sinkage.mean(axis=1))) for t in (over, flat)]
    assert shake[0] > 2 * shake[1]


def test_ribs_lie_on_their_surface_only():
    floor = four_zones(["ribbed", "firm", "firm", "firm"], middle=(0.0, 0.0))
    found = ribs(floor, SURFACES, (0.0, 0.0, 0.0))
    assert len(found) > 20
    for x, low, high, height in found:
        assert surface_at(floor, x, 0.5 * (low + high)) == "ribbed"
        assert low < high
        assert height == SURFACES["ribbed"].rib_height_m


def test_every_roller_feels_the_floor_beneath_it():
    cells = np.array([[0, 1]])
    floor = FloorMap(("firm", "soft"), cells, (-2.0, -2.0), 2.0)  # soft where x is above 0
    plant = SimulatedRobot(Site(CENTRED, surfaces=EVEN), floor, "as_built")
    x = plant.data.geom_xpos[plant.model.geom("roller0_0").id, 0]
    assert x > 0
    rolling = plant.model.geom_friction[:, 2]
    assert rolling[plant.model.geom("roller0_0").id] == pytest.approx(SURFACES["soft"].rolling_m)
    assert rolling[plant.model.geom("roller1_0").id] == pytest.approx(SURFACES["firm"].rolling_m)
    sinkage = plant.robot.wheel_radius_m - plant.data.xpos[plant.wheel_body, 2]
    assert sinkage[0] > 2 * sinkage[1]


def test_a_map_acts_up_to_its_edges():
    cells = np.array([[0, 1]])
    floor = FloorMap(("firm", "soft"), cells, (-3.0, -3.0), 3.0)
    plant = SimulatedRobot(Site(CENTRED, surfaces=EVEN), floor, "as_built", (-2.8, 1.0, 0.0))
    places = np.stack([np.linspace(-3.5, 3.5, 90), np.full(90, 1.2)], axis=1)
    places = places[np.abs(places[:, 0]) > 0.01]  # looked up in cells of some millimetres
    np.testing.assert_array_equal(plant.terrain.at(places) // LEVELS, floor.at(places))


def test_the_centre_of_mass_is_where_it_is_put_also_with_uneven_wheels():
    robot = replace(
        OmniBuild(), wheel_azimuths_deg=(0.0, 90.0, 210.0), centres_m={"as_built": (0.01, 0.01)}
    )
    plant = standing("firm", robot)
    mujoco.mj_comPos(plant.model, plant.data)
    x, y, _ = plant.pose
    centre = plant.data.subtree_com[plant.model.body("chassis").id, :2] - (x, y)
    np.testing.assert_allclose(centre, [0.01, 0.01], atol=1e-3)


@pytest.mark.slow
def test_a_command_arrives_after_its_delay():
    for delay in (0.02, 0.12):
        trace = drive(straight("firm", "as_built", 0.0, 0.2, 0.1), Site(command_delay_s=delay), 0)
        first = trace.time[np.argmax(np.abs(trace.wheel_command[:, 0]) > 0)]
        assert first == pytest.approx(delay, abs=0.0015)


@pytest.mark.slow
def test_compaction_and_body_drag_slow_a_robot():
    run = straight("soft", "as_built", 1.0, 0.2, 0.5)
    free = replace(EVEN["soft"], compaction=0.0, body_drag_n=0.0)
    far = [
        np.hypot(*body_step(drive(run, Site(surfaces={**EVEN, "soft": g}), 0))[:2])
        for g in (free, replace(free, compaction=1e4), replace(free, body_drag_n=5.0))
    ]
    assert far[1] < 0.95 * far[0]
    assert far[2] < 0.95 * far[0]


def test_what_is_added_to_the_engine_only_takes_energy():
    plant = standing("soft", OmniBuild())
    rng = np.random.default_rng(0)
    twists = [[0.0, 0.0, 0.5], [0.2, 0.0, 0.0], *rng.uniform(-0.3, 0.3, (20, 3))]
    for vx, vy, turn in twists:
        plant.data.qvel[:6] = [vx, vy, 0.0, 0.0, 0.0, turn]
        plant._apply_resistance()
        force = plant.data.qfrc_applied[:6]
        assert force @ plant.data.qvel[:6] < 0
        if vx == vy == 0:
            assert force[5] * turn < 0


# motors


def test_a_held_motor_draws_current_by_ohms_law_and_a_free_one_none():
    motor = MotorBuild(supply_ohm=0.0, efficiency=1.0)
    loop = SpeedLoop(kind="pi", gain=100.0, integral=0.0, filter_s=0.0)
    held = WheelDrives(motor, loop, 16.0, 1, 1e-3)
    for _ in range(30):
        torque = held.step([5.0], [0.0], [0.0])
    assert held.voltage[0] == motor.supply_v
    assert held.current[0] == pytest.approx(motor.supply_v / motor.resistance_ohm, rel=1e-6)
    assert torque[0] == pytest.approx(16 * motor.back_emf_vs * held.current[0], rel=1e-6)
    free = WheelDrives(motor, loop, 16.0, 1, 1e-3)
    speed = motor.supply_v / motor.back_emf_vs / 16
    for k in range(30):
        free.step([100.0], [speed * k * 1e-3], [speed])
    assert free.current[0] == pytest.approx(0.0, abs=1e-9)


def test_current_rises_with_the_time_constant_of_the_winding():
    motor = MotorBuild(supply_ohm=0.0)
    held = WheelDrives(motor, SpeedLoop(gain=100.0, integral=0.0), 16.0, 1, 1e-4)
    tau = motor.inductance_h / motor.resistance_ohm
    for _ in range(round(tau / 1e-4)):
        held.step([5.0], [0.0], [0.0])
    full = motor.supply_v / motor.resistance_ohm
    assert held.current[0] == pytest.approx((1 - np.exp(-1)) * full, rel=0.03)


def test_the_supply_sags_under_load_and_limits_the_voltage():
    motor = MotorBuild(supply_ohm=1.0)
    held = WheelDrives(motor, SpeedLoop(gain=100.0), 16.0, 3, 1e-3)
    for _ in range(50):
        held.step([5.0, 5.0, 5.0], STILL, STILL)
    drawn = sum(held.current)
    assert held.bus == pytest.approx(motor.supply_v - drawn, rel=1e-3)
    assert held.bus < 0.75 * motor.supply_v
    assert max(held.voltage) == pytest.approx(held.bus, rel=1e-3)


def test_a_gear_takes_its_part_of_what_drives_only():
    motor = MotorBuild(efficiency=0.8)
    torque = []
    for speed in (3.0, -3.0):
        drive_ = WheelDrives(motor, SpeedLoop(gain=0.0, integral=0.0), 16.0, 1, 1e-3)
        drive_.current = [1.0]
        drive_._decay = 1.0  # current held
        torque.append(drive_.step([0.0], [0.0], [speed])[0])
    assert torque[0] == pytest.approx(0.8 * torque[1])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pi", "feed_forward", "cascade"])
def test_every_speed_loop_drives_the_robot(kind):
    gains = {"pi": {}, "feed_forward": {"gain": 0.4}, "cascade": {"gain": 0.05, "integral": 1.0}}
    site = Site(loop=SpeedLoop(kind=kind, **gains[kind]))
    trace = drive(straight("medium", "as_built", 0.7, 0.2, 0.5), site, 0)
    steady = (trace.time > 1.2) & (trace.time < 2.3)
    wanted, got = (x[steady].mean(axis=0) for x in (trace.wheel_command, trace.wheel_speed))
    # proportional control alone leaves an error
    np.testing.assert_allclose(got, wanted, atol=1.0 if kind == "feed_forward" else 0.15)
    if kind == "feed_forward":
        assert np.abs(got - wanted).max() > 0.05


# experiments


def test_the_plans_have_the_runs_of_the_published_logs():
    plan = HeadingRuns(surface="soft", step_deg=5.0, speeds_m_s=[0.1, 0.2, 0.3])
    assert len(plan.runs()) == 216
    grid = PaperGridRuns(surface="soft").runs()
    assert len(grid) == 8 + 8 + 6 + 6 + 6
    assert {round(float(np.hypot(*r.program.legs[0][0][:2])), 2) for r in grid} == {
        0.0, 0.1, 0.14, 0.2, 0.28, 0.3, 0.4, 0.42,
    }  # fmt: skip
    arcs = CurveRuns(surface="soft", load="moved", count=4, speeds_m_s=[0.2]).runs()
    assert {run.program.legs[0][0][2] > 0 for run in arcs} == {True, False}
    names = [name for name, _ in named_runs(grid, 0.1, 0)]
    assert len(set(names)) == len(names)
    assert names[0] == "as_built/soft/run000"


def test_a_timed_program_ends():
    program = TimedTwists((((0.1, 0.0, 0.0), 1.0), ((0.0, 0.0, 0.2), 0.5)))
    plant = Mock(spec=SimulatedRobot, time=0.5)
    twists = program.twists(plant)
    assert next(twists) == (0.1, 0.0, 0.0)
    plant.time = 1.2
    assert next(twists) == (0.0, 0.0, 0.2)
    plant.time = 1.5
    assert list(twists) == []


@pytest.mark.slow
def test_the_rectangle_is_driven_by_encoders_and_better_by_camera():
    site = Site()
    floor = four_zones(["firm", "medium", "soft", "short"])
    closure = {}
    for by in ("encoders", "camera"):
        trace = drive(RectangleRuns(map="zones", by=by).runs(floor, 0)[0], site, 0)
        closure[by] = np.hypot(*(trace.pose[-1, :2] - trace.pose[0, :2]))
        if by == "encoders":
            np.testing.assert_allclose(rolled(trace, site.robot)[:2], 0.0, atol=0.05)
    assert closure["camera"] < 0.05 < closure["encoders"]


@pytest.mark.slow
def test_way_points_by_camera_are_reached():
    floor = uniform("medium")
    run = WanderRuns(map="site", count=1, points=1).runs(floor, 5)[0]
    assert run.surface is None
    near = replace(run, program=Waypoints(((run.start[0] + 0.3, run.start[1]),), 0.3, "camera"))
    trace = drive(near, Site(), 0)
    far = np.hypot(*(trace.pose[-1, :2] - near.program.places[0]))
    assert far < 0.06


@pytest.mark.slow
def test_the_same_seed_drives_the_same_run():
    run = straight("soft", "as_built", 1.0, 0.2, 0.2)
    one, same, other = (drive(run, Site(), seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.pose, same.pose)
    np.testing.assert_array_equal(one.current, same.current)
    assert np.abs(one.pose[-1] - other.pose[-1]).max() > 1e-4


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: OmniBuild(rollers=7), r"rollers\s+Input should be a multiple of 2"),
        (lambda: OmniBuild(roller_radius_m=0.05), "roller_radius_m = 0.05 is not less than wheel"),
        (lambda: OmniBuild(mass_kg=1.0), "less than the mass of the wheels"),
        (lambda: OmniBuild(centres_m={"far": (0.2, 0.0)}), "centres_m.far: the centre of mass"),
        (
            lambda: OmniBuild(wheel_azimuths_deg=(0.0, 90.0)),
            r"wheel_azimuths_deg\s+Tuple should have at least 3",
        ),
        (
            lambda: MotorBuild(resistance_ohm=0.0),
            r"resistance_ohm\s+Value error, .*expected a number from 1e-06",
        ),
        (
            lambda: MotorBuild(efficiency=1.2),
            r"efficiency\s+Value error, 1.2; expected a number from 0.001 to 1",
        ),
        (lambda: SurfacePhysics(friction=float("nan")), r"friction\s+Value error, nan; expected"),
        (lambda: SurfacePhysics(colour="red"), r"colour\s+.*pattern"),
        (lambda: SpeedLoop(gain=-1.0), r"gain\s+Value error, -1.0; expected a number from 0"),
    ],
)
def test_numbers_that_make_no_robot_are_refused(make, match):
    with pytest.raises(ValueError, match=match):
        make()
