"""The dynamics against closed forms and SciPy, the filter against textbook formulas."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import check_grad
from scipy.stats import chi2

from slipid.baselines.interface import TRIES, ByFloor, Run, body_increments, path_of
from slipid.baselines.motion.ward_iagnemma import (
    GRAVITY,
    REST,
    Dynamics,
    Filter,
    Law,
    Noise,
    Padded,
    State,
    WardIagnemma,
    Windows,
    pulls,
)
from tests.helpers.made_runs import HUSKY, ROBOTINO, made_run, straight

MACHINES = pytest.mark.parametrize("machine", [ROBOTINO, HUSKY], ids=["omni", "skid"])
FLOOR = Law(rise=15.0, rolling=0.15, turning=0.1, drag=3.0)


def held(rolling: np.ndarray, law: Law, machine=ROBOTINO, seconds: float = 20.0) -> np.ndarray:
    """Twist of a robot whose wheels have long turned as the rolling twist says."""
    dynamics = Dynamics.of(machine, law)
    q = np.atleast_2d(rolling) * machine.size
    each = np.ones(len(q))
    step = dynamics.step(q, law.rolling * each, q @ dynamics.rims.T, seconds * each)
    return step.speeds / machine.size


def driven(law: Law, seed: int, machine=ROBOTINO, **more) -> Run:
    """A run of 4 s with two twists that the wheels keep, the body moving by the law."""
    rng = np.random.default_rng(seed)
    rolling = rng.uniform([-0.3, -0.3, -0.5], [0.3, 0.3, 0.5], (2, 3)) * [1, machine is ROBOTINO, 1]
    twice = np.repeat(rolling, 20, axis=0)
    true = np.repeat(held(rolling, law, machine), 20, axis=0)
    return made_run(twice, true, machine=machine, name=f"made{seed}", **more)


def test_at_constant_speed_traction_equals_resistance():
    """Ahead on two drives: C1 (1 - exp(-A u)) = rho v / sqrt(v^2 + v_s^2), solved for u."""
    law = Law(rise=12.0, viscous=0.0, rolling=0.25)
    v = held(np.array([0.5, 0.0, 0.0]), law, HUSKY, 1e6)[0]
    u = -np.log(1.0 - law.rolling * v[0] / np.hypot(v[0], REST) / law.grip) / law.rise
    assert v[0] == pytest.approx(0.5 - u, rel=1e-5)
    assert v[1:] == pytest.approx([0.0, 0.0], abs=1e-6)


def test_an_omni_robot_between_two_wheels_slides_by_what_both_must_pull():
    """Along x two of three wheels pull, at 30 deg: 2 (N T) cos 30 = rho m g, and N = m g / 3."""
    law = Law(rise=12.0, viscous=0.0, rolling=0.25, turning=0.3)
    v = held(np.array([0.5, 0.0, 0.0]), law, seconds=1e6)[0]
    share = law.rolling * v[0] / np.hypot(v[0], REST) * np.sqrt(3.0) / law.grip
    u = -np.log(1.0 - share) / law.rise
    assert np.cos(np.pi / 6) * (0.5 - v[0]) == pytest.approx(u, rel=1e-4)


def test_viscous_forces_alone_share_speeds_by_their_slopes():
    """C2 u = rho c v along, and rollers leave the other speeds alike."""
    law = Law(grip=0.0, viscous=0.3, rolling=1e-9, turning=0.0, drag=0.2e9)
    v = held(np.array([0.2, -0.1, 0.0]), law, seconds=1e6)[0]
    # J^T J = 1.5 on three wheels with N = m g / 3: half of all wheels' slope
    kept = 0.5 * 0.3 / (0.5 * 0.3 + 0.2)
    assert v[:2] == pytest.approx([0.2 * kept, -0.1 * kept], rel=1e-4)


@MACHINES
def test_small_steps_follow_the_differential_equation(machine):
    law = replace(FLOOR, viscous=0.3)
    dynamics = Dynamics.of(machine, law)
    rim, rho = np.array([[0.4, 0.1, -0.2]]) @ dynamics.rims.T, np.array([law.rolling])

    def rate(_time, q):
        slide = rim[0] - dynamics.rims @ q
        load = GRAVITY / len(rim[0])
        pull = law.grip * np.sign(slide) * (1 - np.exp(-law.rise * np.abs(slide)))
        force = dynamics.rims.T @ (load * (pull + law.viscous * slide))
        x, y, turn = q
        p = np.array([x, y, 0.0]) if machine is ROBOTINO else np.array([x, 0.0, 0.0])
        t = q - p
        force -= GRAVITY * law.rolling * p * (1 / np.sqrt(p @ p + REST**2) + law.drag)
        force -= GRAVITY * law.turning * t / np.sqrt(t @ t + REST**2)
        yaw = turn / machine.base_radius
        return force * [1, 1, 2] + np.array([yaw * y, -yaw * x, 0.0])

    start = np.array([0.05, -0.1, 0.2])
    exact = solve_ivp(rate, (0.0, 0.2), start, method="Radau", rtol=1e-9, atol=1e-11).y[:, -1]
    ends = []
    for count in (40, 80):
        q = start[None]
        for _ in range(count):
            q = dynamics.step(q, rho, rim, np.array([0.2 / count])).speeds
        ends.append(q[0])
    # of first order: what is left halves with the step
    assert 2 * ends[1] - ends[0] == pytest.approx(exact, abs=2e-4)


@MACHINES
def test_a_step_solves_its_equation_however_stiff(machine):
    rng = np.random.default_rng(0)
    for _ in range(10):
        law = Law(
            grip=np.exp(rng.uniform(-3, 0.5)),
            rise=np.exp(rng.uniform(0, 5)),
            rolling=np.exp(rng.uniform(-7, -0.5)),
            turning=np.exp(rng.uniform(-7, -0.5)),
        )
        dynamics = Dynamics.of(machine, law)
        q, rolling = rng.normal(size=(2, 20, 3)) * 0.3
        rim, rho, dt = rolling @ dynamics.rims.T, np.full(20, law.rolling), np.full(20, 0.2)
        after = dynamics.step(q, rho, rim, dt).speeds
        left = after - q - 0.2 * dynamics.push(after, rho, rim).rate
        assert np.abs(left).max() < 1e-5


@MACHINES
def test_the_derivatives_of_a_step(machine):
    rng = np.random.default_rng(1)
    for _ in range(2):
        q, rolling = rng.normal(size=(2, 1, 3)) * 0.2
        dynamics = Dynamics.of(machine, FLOOR)
        rim, dt = rolling @ dynamics.rims.T, np.array([0.15])

        def after(x, axis, dynamics=dynamics, rim=rim, dt=dt):
            return dynamics.step(x[None, :3], x[3:], rim, dt).speeds[0, axis]

        def derivative(x, axis, dynamics=dynamics, rim=rim, dt=dt):
            step = dynamics.step(x[None, :3], x[3:], rim, dt)
            return np.append(step.by_speeds[0, axis], step.by_rolling[0, axis])

        for axis in range(3):
            x = np.append(q[0], 0.12)
            assert check_grad(after, derivative, x, axis, epsilon=1e-5) < 1e-3


def test_a_robot_that_stands_keeps_standing():
    still = made_run(np.zeros((40, 3)), current=np.full((40, 3), 0.5), gyro=np.full(40, 0.02))
    for method in (WardIagnemma(), WardIagnemma.with_current()):
        said = method.predict([still.heard], ROBOTINO)[0]
        assert said.path[:, :2] == pytest.approx(np.zeros((41, 2)), abs=1e-6)
        assert said.slipping == pytest.approx(np.zeros(40))
    without = replace(still.heard, gyro=None)
    assert WardIagnemma().predict([without], ROBOTINO)[0].path == pytest.approx(np.zeros((41, 3)))


def test_linear_traction_makes_it_the_linear_kalman_filter():
    """Turning on the spot without resistance, by the textbook: yaw rate, bias, and yaw."""
    rng = np.random.default_rng(2)
    law = Law(grip=0.0, viscous=0.2, rolling=0.0, turning=0.0)
    noise = Noise(rolling=0.0, drift=(0.0, 0.0, 0.004), gyro=0.03, bias=0.05)
    wheels, gyro, dt, radius = rng.normal(size=40), rng.normal(size=40), 0.1, 0.125
    rolling = np.outer(wheels, [0.0, 0.0, 1.0])
    heard = made_run(rolling, gyro=gyro, dt=dt).heard
    own = Filter(Dynamics.of(ROBOTINO, law), noise, 10.0, hears_current=False, wander=0.0)
    tracked = own.track(Padded.of([heard], ROBOTINO))

    # 2 (N / m) C2 u of three wheels, the 2 by the inertia m L^2 / 2
    slope = 2 * GRAVITY * 0.2
    x, spread = np.array([wheels[0], 0.0, 0.0]), np.diag([0.0, 0.05**2, 0.0])
    kept = 1 / (1 + dt * slope)
    move = np.diag([kept, 1.0, 1.0])
    process = np.diag([(0.004 / radius) ** 2 / dt, 0.0, 0.0])
    measure = np.array([[1.0, 1.0, 0.0]])
    for wheel, rate, told in zip(wheels, gyro, tracked.speeds[0, :, 2] / radius, strict=True):
        x = move @ x + np.array([(1 - kept) * wheel, 0.0, 0.0])
        spread = move @ spread @ move.T + process
        size = measure @ spread @ measure.T + 0.03**2 * 0.5 / dt
        gain = spread @ measure.T / size * [[1.0], [1.0], [0.0]]
        x = x + (gain * (rate - measure @ x)).ravel()
        left = np.eye(3) - gain @ measure
        spread = left @ spread @ left.T + gain @ gain.T * 0.03**2 * 0.5 / dt
        assert told == pytest.approx(x[0], abs=1e-5)
        turn = np.array([[1.0, 0, 0], [0, 1, 0], [dt, 0, 1]])
        spread = turn @ spread @ turn.T
    assert tracked.covariance[0, 2, 2] == pytest.approx(spread[2, 2], rel=1e-4)


def test_a_measurement_is_that_of_the_textbook_but_for_the_pose():
    rng = np.random.default_rng(3)
    root, row = rng.normal(size=(8, 8)), rng.normal(size=8)
    row[5:] = 0.0
    spread, mean = root @ root.T, rng.normal(size=5)
    state = State(mean[None], spread[None])
    after = state.corrected(row[None], np.array([0.7]), np.array([0.3]))
    gain = spread @ row / (row @ spread @ row + 0.3)
    assert after.mean[0] == pytest.approx(mean + 0.7 * gain[:5])
    assert after.spread[0, :5, :5] == pytest.approx((spread - np.outer(gain, row @ spread))[:5, :5])
    assert after.spread[0, 5:, 5:] == pytest.approx(spread[5:, 5:])
    own = np.append(gain[:5], np.zeros(3))
    left = np.eye(8) - np.outer(own, row)
    joseph = left @ spread @ left.T + 0.3 * np.outer(own, own)
    assert after.spread[0] == pytest.approx(joseph)
    one = state.corrected(row[None], np.array([0.7]), np.array([0.3]), slice(3, 4))
    assert one.mean[0] == pytest.approx(mean + 0.7 * gain[:5] * [0, 0, 0, 1, 0])
    two = State(np.tile(mean, (2, 1)), np.tile(spread, (2, 1, 1)))
    for news, variance in ((np.nan, 0.3), (0.7, np.nan)):
        heard = two.corrected(
            np.tile(row, (2, 1)), np.array([0.7, news]), np.array([0.3, variance])
        )
        assert heard.mean == pytest.approx(np.stack([after.mean[0], mean]))
        assert heard.spread == pytest.approx(np.stack([after.spread[0], spread]))


def test_resistance_that_pushes_or_exceeds_traction_is_pulled_back():
    law, noise = Law(drag=2.0), Noise(rolling=0.1)
    own = Filter(Dynamics.of(ROBOTINO, law), noise, 10.0, hears_current=False, wander=0.0)
    mean = np.array([[0.3, 0.4, 9.0, rho, 0.0] for rho in (-0.2, 0.1, 0.8)])
    spread = np.tile(np.diag([0.0, 0, 0, 0.01, 0, 0, 0, 0]), (3, 1, 1))
    after = own._bounded(State(mean, spread)).mean[:, 3]
    # a hundredth of the prior's variance: a hundred parts of the bound in a hundred and one
    assert after == pytest.approx([-0.2 / 101, 0.1, 0.3 + (0.8 - 0.3) / 101])


def test_wheels_that_spin_on_the_spot_are_told():
    run = made_run(straight(0.0), current=np.ones((40, 3)))
    stuck = WardIagnemma(law=Law(rolling=2.0), noise=Noise(rolling=1e-6))
    rolls = WardIagnemma(law=Law(rise=200.0, rolling=1e-3), noise=Noise(rolling=1e-6))
    assert (stuck.predict([run.heard], ROBOTINO)[0].slipping[3:] > 0.8).all()
    assert (rolls.predict([run.heard], ROBOTINO)[0].slipping < 0.05).all()


@pytest.mark.slow
@MACHINES
def test_what_was_driven_by_the_law_is_foretold(machine):
    runs = [driven(FLOOR, k, machine) for k in range(14)]
    fitted = WardIagnemma().fit(runs[:10], machine)
    foretold = fitted.predict([run.heard for run in runs[10:]], machine)
    # after the wheels change, the robot's mass needs some steps to follow
    settled = np.r_[10:20, 30:40]
    for run, said in zip(runs[10:], foretold, strict=True):
        twist = body_increments(said.path) / run.heard.dt[:, None]
        off = np.abs((twist - run.twist) * machine.size)[settled]
        slip = np.abs((run.heard.rolling(machine) - run.twist) * machine.size)[settled]
        assert off.max() < 0.05 * slip.max()


@pytest.mark.slow
def test_the_law_is_found_again():
    fitted = WardIagnemma().fit([driven(FLOOR, k) for k in range(20)], ROBOTINO)
    assert fitted.law.rise == pytest.approx(FLOOR.rise, rel=0.1)
    assert fitted.law.rolling == pytest.approx(FLOOR.rolling, rel=0.1)
    assert fitted.law.turning == pytest.approx(FLOOR.turning, rel=0.15)
    assert fitted.law.drag == pytest.approx(FLOOR.drag, rel=0.2)
    plain = replace(FLOOR, drag=0.0)
    runs = [driven(plain, k) for k in range(5)]
    assert WardIagnemma(with_drag=False).fit(runs, ROBOTINO).law.drag == 0.0


TRUE = Noise(0.03, (0.003, 0.004, 0.002), 0.02, 0.03)


def scattered(count: int, gyro: bool, noise: Noise = TRUE) -> list[Run]:
    """Runs as the filter believes in: rho, bias and twists scatter as its noise says."""
    rng = np.random.default_rng(0)
    dynamics, dt = Dynamics.of(ROBOTINO, FLOOR), np.full(count, 0.1)
    rolling = np.stack([straight(angle, 0.25, 60) for angle in rng.uniform(-3, 3, count)])
    rho = FLOOR.rolling + noise.rolling * rng.normal(size=count)
    q, twist = rolling[:, 0], np.zeros((count, 60, 3))
    for k in range(60):
        q = dynamics.step(q, rho, rolling[:, k] @ dynamics.rims.T, dt).speeds
        q = q + noise.drift * rng.normal(size=(count, 3)) / np.sqrt(0.1)
        twist[:, k] = q / ROBOTINO.size
    yaw = twist[:, :, 2] + noise.bias * rng.normal(size=(count, 1))
    yaw = yaw + noise.gyro * np.sqrt(5) * rng.normal(size=(count, 60))
    return [made_run(rolling[k], twist[k], gyro=yaw[k] if gyro else None) for k in range(count)]


@pytest.mark.slow
@pytest.mark.parametrize("gyro", [False, True])
def test_nine_ends_of_ten_lie_in_their_regions(gyro):
    runs = scattered(400, gyro)
    method = WardIagnemma(law=FLOOR, noise=TRUE)
    said = method.predict([run.heard for run in runs], ROBOTINO)
    off = np.array(
        [one.path[-1, :2] - run.pose[-1, :2] for one, run in zip(said, runs, strict=True)]
    )
    spread = np.array([one.end_covariance for one in said])
    square = np.einsum("ri,rij,rj->r", off, np.linalg.inv(spread), off)
    assert np.mean(square < chi2.ppf(0.9, 2)) == pytest.approx(0.9, abs=0.045)
    assert square.mean() == pytest.approx(2.0, rel=0.2)


@pytest.mark.slow
def test_the_gyro_makes_the_end_surer():
    noise = Noise(0.03, (0.003, 0.004, 0.02), 0.001, 0.001)
    method = WardIagnemma(law=FLOOR, noise=noise)
    for run in scattered(3, True):
        sure, unsure = method.predict([run.heard, replace(run.heard, gyro=None)], ROBOTINO)
        assert np.linalg.det(sure.end_covariance) < 0.2 * np.linalg.det(unsure.end_covariance)


@pytest.mark.slow
def test_noise_is_found_again():
    true, fitted = TRUE, WardIagnemma().fit(scattered(40, True), ROBOTINO).noise
    assert fitted.bias == pytest.approx(true.bias, rel=0.3)
    assert fitted.gyro == pytest.approx(true.gyro, rel=0.15)
    # what of the drift goes along the motion is partly taken for resistance
    assert fitted.drift[2] == pytest.approx(true.drift[2], rel=0.5)
    assert fitted.rolling == pytest.approx(true.rolling, rel=0.6)


def pulling(run: Run, law: Law, gain: float, offset: float, noise: float = 0.0) -> Run:
    """The run with currents of the traction, as a motor's constant and friction make of it."""
    dynamics = Dynamics.of(ROBOTINO, law)
    rim = run.heard.speed * ROBOTINO.wheel_radius
    slide = rim - (run.twist * ROBOTINO.size) @ dynamics.rims.T
    force = gain * ROBOTINO.mass * np.sign(rim) * dynamics.traction(slide) + offset
    force = force + noise * np.random.default_rng(0).normal(size=force.shape)
    scale = ROBOTINO.gear_ratio * ROBOTINO.back_emf / ROBOTINO.wheel_radius
    # a meter with signs: along the wheel's forward direction
    current = force / scale * np.sign(rim)
    return replace(run, heard=replace(run.heard, current=current, current_is_signed=True))


def test_the_force_of_a_current_is_that_of_gear_motor_and_wheel():
    heard = made_run(straight(0.0), current=np.tile([0.5, 0.2, 0.7], (40, 1))).heard
    force = pulls(heard, ROBOTINO)[0]
    assert force[[0, 2]] == pytest.approx(np.array([0.5, 0.7]) * 16 * 0.05 / 0.04)
    assert np.isnan(force[1])
    assert np.isnan(pulls(replace(heard, current=None), ROBOTINO)).all()


@pytest.mark.slow
def test_gain_and_offset_of_the_currents_are_found_again():
    runs = [pulling(driven(FLOOR, k), FLOOR, 1.3, 2.0) for k in range(20)]
    fitted = WardIagnemma.with_current().fit(runs, ROBOTINO)
    assert fitted.noise.gain == pytest.approx(1.3, rel=0.03)
    assert fitted.noise.offset == pytest.approx(2.0, abs=0.3)
    assert fitted.noise.force < 0.5


def test_currents_tell_runs_that_resist_more():
    heavier = replace(FLOOR, rolling=0.25)
    noise = Noise(rolling=0.05, drift=(1e-3, 1e-3, 1e-3), force=0.5)
    run = pulling(driven(heavier, 5), FLOOR, 1.0, 0.0)
    method = replace(WardIagnemma.with_current(), law=FLOOR, noise=noise)
    deaf = replace(method, needs=frozenset())
    ends = [m.predict([run.heard], ROBOTINO)[0].path[-1, :2] for m in (method, deaf)]
    off = [np.linalg.norm(end - run.pose[-1, :2]) for end in ends]
    assert off[0] < 0.3 * off[1]


@pytest.mark.slow
def test_the_noise_of_currents_is_that_of_the_means_of_runs():
    """What is the same all along a run counts as much as it moves the mean of a run's wheel."""
    rng = np.random.default_rng(1)
    runs = []
    for k in range(30):
        run = pulling(driven(FLOOR, k), FLOOR, 1.0, rng.normal())
        runs.append(run)
    noise = WardIagnemma.with_current().fit(runs, ROBOTINO).noise
    counts = [np.isfinite(pulls(run.heard.windowed(), ROBOTINO)).sum() for run in runs]
    assert noise.force == pytest.approx(np.sqrt(np.mean(counts) / 3), rel=0.35)


def test_runs_do_not_tell_on_those_beside_them():
    short = driven(FLOOR, 1).heard
    long = made_run(straight(1.0, 0.2, 70), gyro=np.zeros(70), current=np.ones((70, 3))).heard
    method = WardIagnemma(law=FLOOR)
    both, alone = method.predict([long, short], ROBOTINO)[1], method.predict([short], ROBOTINO)[0]
    assert both.path == pytest.approx(alone.path, abs=1e-7)
    assert both.end_covariance == pytest.approx(alone.end_covariance, rel=1e-4)


def test_the_spread_of_the_end_is_that_of_paths_with_other_twists():
    """Turning fast: by differences of the end with noise in the twist of each of two steps."""
    noise = Noise(rolling=0.0, drift=(0.01, 0.02, 0.03))
    heard = made_run(np.tile([0.3, -0.2, 2.0], (2, 1)), dt=0.2).heard
    dynamics = Dynamics.of(ROBOTINO, FLOOR)
    own = Filter(dynamics, noise, 10.0, hears_current=False, wander=0.0)
    runs = Padded.of([heard], ROBOTINO)

    def end(shaken):
        q, twist = runs.rolling[:, 0], np.zeros((2, 3))
        for k in range(2):
            rho = np.array([FLOOR.rolling])
            q = dynamics.step(q, rho, runs.rim[:, k], heard.dt[:1]).speeds + shaken[k]
            twist[k] = q[0] / ROBOTINO.size
        return path_of(twist, heard.dt)[-1]

    spread = np.zeros((3, 3))
    for k in range(2):
        for axis in range(3):
            shaken = np.zeros((2, 3))
            shaken[k, axis] = 1e-4
            by = (end(shaken) - end(-shaken)) / 2e-4
            spread += np.outer(by, by) * noise.drift[axis] ** 2 / 0.2
    told = own.track(runs).covariance[0]
    scale = np.sqrt(np.outer(spread.diagonal(), spread.diagonal()))
    assert told / scale == pytest.approx(spread / scale, abs=0.002)


def test_rho_that_wanders_makes_the_end_less_sure():
    heard = made_run(straight(0.2)).heard
    noise = Noise(0.02, (1e-4, 1e-4, 1e-4))
    spread = [
        np.trace(
            WardIagnemma(law=FLOOR, noise=noise, wander=w)
            .predict([heard], ROBOTINO)[0]
            .end_covariance
        )
        for w in (0.0, 0.5)
    ]
    # over 4 s: T^2 of the start, and w^2 T^3 / 3 more
    assert spread[1] / spread[0] == pytest.approx(1.0 + 0.25 * 4.0 / 3.0, rel=0.05)


def test_a_skid_steer_that_turns_with_a_gyro_and_by_floor():
    runs = [driven(FLOOR, k, HUSKY) for k in range(8)]
    heard = [replace(r.heard, gyro=r.twist[:, 2]) for r in runs]
    runs = [replace(r, heard=h) for r, h in zip(runs, heard, strict=True)]
    fitted = ByFloor.of(WardIagnemma()).fit(runs, HUSKY)
    for run, said in zip(runs, fitted.predict(heard, HUSKY), strict=True):
        assert said.path[-1, 2] == pytest.approx(run.pose[-1, 2], abs=0.02)
        assert said.path[-1, :2] == pytest.approx(run.pose[-1, :2], abs=0.05)


def test_windows_are_drawn_from_few_runs_and_thinned_evenly():
    windows = Windows.of([driven(FLOOR, k) for k in range(45)], ROBOTINO)
    assert len(np.unique(windows.run)) == 40
    assert len(windows.dt) == 40 * 8
    assert windows.thinned(100).run.tolist() == windows.run[::4].tolist()
    assert len(windows.thinned(1000).dt) == 320


def test_settings_to_try_and_numbers_fitted():
    method, heard = WardIagnemma(), WardIagnemma.with_current()
    assert (method.name, method.needs) == ("ward_iagnemma", frozenset())
    assert (heard.name, heard.needs) == ("ward_iagnemma_current", {"current"})
    for one in (method, heard):
        tried = one.candidates()
        assert len({repr(m) for m in tried}) == len(tried) <= TRIES
        assert {(m.name, m.needs) for m in tried} == {(one.name, one.needs)}
    assert (method.numbers, replace(method, with_drag=False).numbers, heard.numbers) == (8, 7, 11)
    run = driven(FLOOR, 0)
    run = replace(run, heard=replace(run.heard, gyro=run.twist[:, 2]))
    assert method.fit([run], ROBOTINO).numbers == 10
