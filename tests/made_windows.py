"""Windows made straight from the model, noise included: small, fast, with every number known."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from slipid.data.dataset import Windows
from slipid.identify import likelihood as lk
from slipid.model.geometry import omni
from slipid.model.robot import build, compose

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
        std: of the variance components by name (`lk.noise`), those left out are zero; `current` [A]
            and `voltage` [V] are noise of every window.
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
    w = Windows(
        run=np.arange(runs),
        surface=tuple(labels[k % len(labels)] for k in range(runs)),
        load=tuple(loads[k // 2 % len(loads)] for k in range(runs)),
        session=tuple(sessions[k // 3 % len(sessions)] for k in range(runs)),
        dt=dt,
        turn=dt[..., None] * rate * rng.normal(1.0, 0.02, (runs, count, 3)),
        faster=rng.normal(0.0, 0.05, (runs, count, 3)),
        pose=np.zeros((runs, count + 1, 3)),
        current=np.zeros((runs, count, 3)),
        voltage=np.zeros((runs, count, 3)),
        current_var=np.full((runs, count, 3), 1e-4),
        has_current=True,
        has_voltage=voltage,
        current_is_signed=signed,
        lag=float(truth.camera.lag),
    )
    return measure(truth, w, rng, std)


def measure(truth, w, rng, std):
    """The windows with poses, currents and voltages as the robot gives them, plus noise."""
    b = lk.batch(w, truth)
    p = jax.jit(lk.predict)(truth, b)
    amps = np.asarray(lk.predicted_current(truth, b, p.felt))
    runs, count = w.dt.shape
    steps = np.asarray(p.increment) + _process(truth, w, rng, std)
    start = rng.normal(0, 0.5, (runs, 3))
    edges = [start]
    for k in range(count):
        edges.append(
            np.asarray(jax.vmap(compose)(jnp.asarray(edges[-1]), jnp.asarray(steps[:, k])))
        )
    pose = np.stack(edges, axis=1)
    pose[..., :2] /= float(truth.camera.scale)
    pose[..., :2] += rng.normal(size=(runs, count + 1, 2)) * std.get("camera.place", 0.0)
    pose[..., 2] += rng.normal(size=(runs, count + 1)) * std.get("camera.heading", 0.0)
    speed = w.turn / w.dt[..., None]
    flow = amps if w.current_is_signed else amps * np.tanh(speed / 0.2)
    volts = np.asarray(truth.motor.voltage(jnp.asarray(flow), jnp.asarray(speed)))
    return replace(
        w,
        pose=pose,
        current=amps + rng.normal(size=amps.shape) * std.get("current", 0.0),
        voltage=volts + rng.normal(size=amps.shape) * std.get("voltage", 0.0),
    )


def _process(truth, w, rng, std):
    far, u = lk.travel(w, truth)
    axes = np.zeros((3, *far.shape, 3))
    axes[0, ..., :2] = u
    axes[1, ..., 0], axes[1, ..., 1] = -u[..., 1], u[..., 0]
    axes[2, ..., 2] = 1.0
    total = np.zeros((*far.shape, 3))
    for axis, name in zip(axes, ("along", "across", "yaw"), strict=True):
        floor = [std.get(f"process.{f}.{name}", std.get(f"process.{name}", 0.0)) for f in w.surface]
        run = [std.get(f"run.{f}.{name}", std.get(f"run.{name}", 0.0)) for f in w.surface]
        noise = np.asarray(floor)[:, None] * np.sqrt(far) * rng.normal(size=far.shape)
        noise += (np.asarray(run) * rng.normal(size=len(w)))[:, None] * far
        total += axis * noise[..., None]
    return total
