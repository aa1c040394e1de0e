"""Windows made straight from the model, noise included: small, fast, with every number known."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from slipid.data.windows import Windows
from slipid.fitting import likelihood as lk
from slipid.lab.selftest.replicates import simulate_windows
from slipid.model.geometry import omni
from slipid.model.robot import build

GEOMETRY = omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0)
SCALE = 1.1


def robot(floors=("firm", "soft"), loads=("as_built", "moved"), sessions=("one", "two")):
    """A robot whose numbers differ between floors, loads and sessions."""
    blank = build(GEOMETRY, list(floors), list(loads), list(sessions))
    shares = [(0.3, 0.28, 0.42), (0.36, 0.3, 0.34)][: len(loads)]
    return eqx.tree_at(
        lambda r: (
            r.surfaces.creep,
            r.surfaces.roller_drag,
            r.body.load_share,
            r.body.mass_ratio,
            r.camera.scale,
            r.camera.lag,
            r.camera.session_yaw,
            r.camera.marker_place,
            r.motor.resistance,
        ),
        blank,
        (
            jnp.linspace(0.1, 0.5, len(floors)),
            jnp.linspace(0.15, 0.35, len(floors)),
            jnp.asarray(shares),
            jnp.linspace(1.0, 1.2, len(loads)),
            jnp.asarray(SCALE),
            jnp.asarray(0.05),
            jnp.linspace(-0.01, 0.02, len(sessions)),
            jnp.array([0.01, -0.005]),
            jnp.asarray(5.5),
        ),
    )


def made(truth, runs=24, count=2, seed=0, std=None, signed=True, voltage=True):
    """Windows of straight and turning runs on every floor, load and session in turn.

    Args:
        std: of the variance components by name (`fit.noise`), those left out are zero; with none
            at all the ammeter has no noise, either.
    """
    rng = np.random.default_rng(seed)
    std = std or {}
    way = 2 * np.pi * np.arange(runs) / runs
    speed = np.where(np.arange(runs) % 2, 0.1, 0.2)
    turn = np.where(np.arange(runs) % 5 == 4, 0.4, 0.0)
    xi = np.stack([speed * np.cos(way), speed * np.sin(way), turn], axis=1)
    rate = (xi @ np.asarray(truth.geometry.forward()).T / 0.04)[:, None, :]
    dt = rng.uniform(0.9, 1.1, (runs, count))
    labels, loads, sessions = truth.surfaces.labels, truth.body.loads, truth.camera.sessions
    turn = dt[..., None] * rate * rng.normal(1.0, 0.02, (runs, count, 3))
    w = Windows(
        run=np.arange(runs),
        surface=tuple(labels[k % len(labels)] for k in range(runs)),
        load=tuple(loads[k // 2 % len(loads)] for k in range(runs)),
        session=tuple(sessions[k // 3 % len(sessions)] for k in range(runs)),
        start=np.zeros(runs),
        dt=dt,
        turn=turn,
        speed_change=rng.normal(0.0, 0.05, (runs, count, 3)),
        direction=np.tanh(turn / dt[..., None] / 0.2),
        pose=rng.normal(0, 0.5, (runs, 1, 3)) * np.ones((count + 1, 1)),
        current=np.zeros((runs, count, 3)),
        voltage=np.zeros((runs, count, 3)),
        current_var=np.full((runs, count, 3), 1e-4 if std else 0.0),
        voltage_var=np.zeros((runs, count, 3)),
        has_current=True,
        has_voltage=voltage,
        current_is_signed=signed,
        lag=float(truth.camera.lag),
    )
    return simulate_windows(truth, w, rng, std)


def electric_noise(b, voltage_std, scatter=0.05, resistance=5.5):
    """What voltages are predicted with when currents scatter so much around predicted ones [A]."""
    pieces, *others = b.turn.shape
    wide = jnp.full((pieces, int(np.prod(others))), scatter**2)
    return lk.ElectricNoise(voltage_std, wide, resistance)


def residuals(robot, b, noise):
    """Every block of residuals, `motion` first; the noise is what voltages are predicted with."""
    p = lk.predict(robot, b)
    motion = {"motion": lk.motion_residual(robot, b, p)}
    return motion | lk.electric_residuals(robot, b, p.motor_force, noise)
