"""The dynamics are checked against closed forms and SciPy."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import check_grad

from slipid.lab.systems.motion.ward_iagnemma_dynamics import (
    V_S,
    Dynamics,
    ForceLaw,
)
from slipid.model.robot import GRAVITY
from tests.helpers.driven_runs import FLOOR, MACHINES, held
from tests.helpers.made_runs import HUSKY, ROBOTINO


def test_at_constant_speed_traction_equals_resistance():
    """Ahead on two drives: C1 (1 - exp(-A u)) = rho v / sqrt(v^2 + v_s^2), solved for u."""
    law = ForceLaw(rise=12.0, viscous=0.0, rolling=0.25)
    v = held(np.array([0.5, 0.0, 0.0]), law, HUSKY, 1e6)[0]
    u = -np.log(1.0 - law.rolling * v[0] / np.hypot(v[0], V_S) / law.grip) / law.rise
    assert v[0] == pytest.approx(0.5 - u, rel=1e-5)
    assert v[1:] == pytest.approx([0.0, 0.0], abs=1e-6)


def test_an_omni_robot_between_two_wheels_slides_by_what_both_must_pull():
    """Along x two of three wheels drive, at 30 deg: 2 (N T) cos 30 = rho m g, and N = m g / 3."""
    law = ForceLaw(rise=12.0, viscous=0.0, rolling=0.25, turning=0.3)
    v = held(np.array([0.5, 0.0, 0.0]), law, seconds=1e6)[0]
    share = law.rolling * v[0] / np.hypot(v[0], V_S) * np.sqrt(3.0) / law.grip
    u = -np.log(1.0 - share) / law.rise
    assert np.cos(np.pi / 6) * (0.5 - v[0]) == pytest.approx(u, rel=1e-4)


def test_viscous_forces_alone_share_speeds_by_their_slopes():
    """C2 u = rho c v along the drive, and free rollers leave the other speeds unchanged."""
    law = ForceLaw(grip=0.0, viscous=0.3, rolling=1e-9, turning=0.0, drag=0.2e9)
    v = held(np.array([0.2, -0.1, 0.0]), law, seconds=1e6)[0]
    # J^T J = 1.5 on three wheels with N = m g / 3: half of all wheels' slope
    kept = 0.5 * 0.3 / (0.5 * 0.3 + 0.2)
    assert v[:2] == pytest.approx([0.2 * kept, -0.1 * kept], rel=1e-4)


@MACHINES
def test_small_steps_follow_the_differential_equation(spec):
    law = replace(FLOOR, viscous=0.3)
    dynamics = Dynamics.of(spec, law)
    rim, rho = np.array([[0.4, 0.1, -0.2]]) @ dynamics.rims.T, np.array([law.rolling])

    def rate(_time, q):
        slide = rim[0] - dynamics.rims @ q
        load = GRAVITY / len(rim[0])
        pull = law.grip * np.sign(slide) * (1 - np.exp(-law.rise * np.abs(slide)))
        force = dynamics.rims.T @ (load * (pull + law.viscous * slide))
        x, y, turn = q
        p = np.array([x, y, 0.0]) if spec is ROBOTINO else np.array([x, 0.0, 0.0])
        t = q - p
        force -= GRAVITY * law.rolling * p * (1 / np.sqrt(p @ p + V_S**2) + law.drag)
        force -= GRAVITY * law.turning * t / np.sqrt(t @ t + V_S**2)
        yaw = turn / spec.base_radius
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
def test_a_step_solves_its_equation_however_stiff(spec):
    rng = np.random.default_rng(0)
    for _ in range(10):
        law = ForceLaw(
            grip=np.exp(rng.uniform(-3, 0.5)),
            rise=np.exp(rng.uniform(0, 5)),
            rolling=np.exp(rng.uniform(-7, -0.5)),
            turning=np.exp(rng.uniform(-7, -0.5)),
        )
        dynamics = Dynamics.of(spec, law)
        q, rolling = rng.normal(size=(2, 20, 3)) * 0.3
        rim, rho, dt = rolling @ dynamics.rims.T, np.full(20, law.rolling), np.full(20, 0.2)
        after = dynamics.step(q, rho, rim, dt).speeds
        left = after - q - 0.2 * dynamics.acceleration(after, rho, rim).rate
        assert np.abs(left).max() < 1e-5


@MACHINES
def test_the_derivatives_of_a_step(spec):
    rng = np.random.default_rng(1)
    for _ in range(2):
        q, rolling = rng.normal(size=(2, 1, 3)) * 0.2
        dynamics = Dynamics.of(spec, FLOOR)
        rim, dt = rolling @ dynamics.rims.T, np.array([0.15])

        def after(x, axis, dynamics=dynamics, rim=rim, dt=dt):
            return dynamics.step(x[None, :3], x[3:], rim, dt).speeds[0, axis]

        def derivative(x, axis, dynamics=dynamics, rim=rim, dt=dt):
            step = dynamics.step(x[None, :3], x[3:], rim, dt)
            return np.append(step.by_speeds[0, axis], step.by_rolling[0, axis])

        for axis in range(3):
            x = np.append(q[0], 0.12)
            assert check_grad(after, derivative, x, axis, epsilon=1e-5) < 1e-3
