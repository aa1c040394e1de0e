"""Speed of the likelihood and of the whole 2022 fit, as ratios within one run.

The rival is the same model in vectorised numpy, all windows at once, warmed up, with one forward
difference per parameter; both must give the same residuals.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import fields, replace
from functools import reduce
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.identify.likelihood import SMOOTH
from slipid.identify.problem import Problem
from slipid.model import contact
from slipid.parameter import Choice, entries
from tests.made_windows import made, robot

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("SLIPID_DATA") or ROOT.parent / "shared" / "data") / "robotino2022"


@pytest.fixture(scope="module")
def problem():
    """The 2022 fit where its logs are present, else made windows of the same size."""
    if DATA.is_dir():
        return real_job().problem()
    floors = ("brown", "gray", "green", "table")
    truth = robot(floors=floors, sessions=tuple("abcdefghi"))
    w = made(truth, runs=472, count=4, signed=False, voltage=False)
    return Problem(
        w, truth, [Choice("camera.*", free=True), Choice("robot.drive_offset", free=True)]
    )


def real_job():
    from slipid.app.config import read_config
    from slipid.app.job import read_job

    config = read_config(ROOT / "configs" / "robotino2022.toml")
    return read_job(config, DATA, lambda *_: None, lambda _: None)


def best_of(function, repeats):
    """Shortest of several times [s], and the last result; the first call is not timed."""
    result = jax.block_until_ready(function())
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        result = jax.block_until_ready(function())
        times.append(time.perf_counter() - began)
    return min(times), result


# the same model in numpy ---------------------------------------------------------------------


def numbers(tree):
    """Every number of a robot by its attribute names from the root, in numpy."""
    return {e.leaf: np.asarray(reduce(getattr, e.leaf, tree)) for e in entries(tree)}


class Rival:
    """Residuals of motion and current of all windows at once, in numpy."""

    def __init__(self, problem):
        self.g, self.b, self.camera = problem.robot.geometry, problem.batch, problem.robot.camera
        shape = self.b.turn.shape[:2]

        def each(index):  # one number per piece -> per window
            return np.repeat(np.asarray(index), shape[1])

        self.floor, self.load, self.session = map(
            each, (self.b.surface, self.b.load, self.b.session)
        )
        self.dt = np.asarray(self.b.dt).ravel()
        self.turn, self.faster, self.amps = (
            np.asarray(x).reshape(-1, x.shape[2])
            for x in (self.b.turn, self.b.faster, self.b.current)
        )

    def frame(self, v):
        drive = np.asarray(self.g.drive_angle) + v["geometry", "drive_offset"]
        p = np.asarray(self.g.place) * v["geometry", "base_radius"]
        roller = np.asarray(self.g.roller_angle)

        def row(a):
            return np.stack(
                [np.cos(a), np.sin(a), p[:, 0] * np.sin(a) - p[:, 1] * np.cos(a)], axis=1
            )

        lever = np.concatenate([np.ones((1, len(p))), p.T])
        return (
            row(drive - roller + np.pi / 2),
            row(drive - roller),
            np.sin(roller),
            np.linalg.pinv(lever)[:, 1:],
        )

    def residuals(self, v):
        hold, roll, pull, shift = self.frame(v)
        late = v["camera", "lag"] - float(self.b.lag)
        speed = (self.turn - late * self.faster) / self.dt[:, None]
        rim = v["geometry", "wheel_radius"] * speed
        s = {k[1]: x[self.floor][:, None] for k, x in v.items() if k[0] == "surfaces"}
        rest = v["body", "load_share"][self.load]
        base = v["geometry", "base_radius"]
        xi = equilibrium(rim, hold, roll, pull, shift, s, rest, base)
        motion = self.seen(advance(xi, self.dt), v) - self.measured(v)
        traction, _, load, *_ = terms(xi, rim, hold, roll, pull, shift, s, rest)
        along, active = xi @ hold.T, np.sqrt(rim**2 + (xi @ roll.T) ** 2 + 1e-12)
        sets_in = contact.V0 + contact.S1 * active
        driven = traction + s["rolling_resistance"] * np.tanh(along / sets_in)
        weight = s["friction"] * v["body", "mass"] * 9.81
        torque = v["geometry", "wheel_radius"] * weight * load * driven
        m = {k[1]: x for k, x in v.items() if k[0] == "motor"}
        drag = m["coulomb_friction"] * np.tanh(speed / 0.2) + m["viscous_friction"] * speed
        amps = (torque + drag) / (self.g.gear_ratio * m["efficiency"] * m["back_emf"])
        amps = np.sqrt(amps**2 + SMOOTH**2) if not self.b.signed else amps
        pieces = len(self.b.dt)
        current = amps + m["current_offset"] - self.amps
        return {"motion": motion.reshape(pieces, -1), "current": current.reshape(pieces, -1)}

    def seen(self, d, v):
        c, s = np.cos(d[:, 2]), np.sin(d[:, 2])
        px, py = v["camera", "marker_place"]
        x, y = d[:, 0] + (c - 1) * px - s * py, d[:, 1] + s * px + (c - 1) * py
        psi = v["camera", "marker_yaw"] + v["camera", "session_yaw"][self.session]
        c, s = np.cos(psi), np.sin(psi)
        return np.stack([c * x + s * y, c * y - s * x, d[:, 2]], axis=1)

    def measured(self, v):
        pose = np.asarray(self.b.pose)
        q = pose[..., :2] - np.asarray(self.camera.centre)
        u = np.stack([np.cos(pose[..., 2]), np.sin(pose[..., 2])], axis=-1)
        k, h, p = (v["camera", name] for name in ("radial", "tilt", "tangential"))
        r2, pq, down = (q * q).sum(-1, keepdims=True), (q @ p)[..., None], 1 + (q @ h)[..., None]
        qu, pu = (q * u).sum(-1, keepdims=True), (u @ p)[..., None]
        bent = q * (1 + k * r2) + p * r2 + 2 * q * pq
        turned = u * (1 + k * r2) + 2 * k * q * qu + 2 * p * qu + 2 * u * pq + 2 * q * pu
        turned = turned / down - bent * (u @ h)[..., None] / down**2
        place = v["camera", "scale"] * bent / down
        turn = np.arctan2(
            u[..., 0] * turned[..., 1] - u[..., 1] * turned[..., 0], (u * turned).sum(-1)
        )
        yaw = pose[..., 2] + turn
        d, a = np.diff(place, axis=1), np.diff(yaw, axis=1)
        c, s = np.cos(yaw[:, :-1]), np.sin(yaw[:, :-1])
        along = np.stack([c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0], a], axis=-1)
        return along.reshape(-1, 3)


def advance(xi, dt):
    w = xi[:, 2] * dt
    small = np.abs(w) < 1e-6
    safe = np.where(small, 1.0, w)
    a = np.where(small, 1 - w * w / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 * w, (1 - np.cos(safe)) / safe)
    return np.stack([(a * xi[:, 0] - b * xi[:, 1]) * dt, (b * xi[:, 0] + a * xi[:, 1]) * dt, w], 1)


def terms(xi, rim, hold, roll, pull, shift, s, rest):
    v = xi[:, :2]
    inv = 1 / np.sqrt((v * v).sum(1, keepdims=True) + 1e-8)
    ahead = v @ shift.T
    load = rest - s["lead"] * ahead * inv
    d_load = -s["lead"][..., None] * (
        shift * inv[..., None] - ahead[..., None] * v[:, None, :] * inv[..., None] ** 3
    )
    along, side = xi @ hold.T, xi @ roll.T
    slide = rim * pull - along
    active = np.sqrt(rim**2 + side**2 + 1e-12)
    scale_t = contact.V0 + s["creep"] * active
    scale_r = contact.VR + s["roller_creep"] * active
    sets_in = contact.V0 + contact.S1 * active
    t, h, u = np.tanh(slide / scale_t), np.tanh(side / scale_r), np.tanh(along / sets_in)
    traction = t + s["slide_viscosity"] * slide - s["rolling_resistance"] * u
    drag = -(s["roller_drag"] * h + s["roller_viscosity"] * side)
    t1, h1 = 1 - t * t, 1 - h * h
    brake = s["rolling_resistance"] * (1 - u * u) / sets_in
    a = -t1 / scale_t - s["slide_viscosity"] - brake
    b = -t1 * slide * s["creep"] * side / active / scale_t**2
    b = b + brake * along * contact.S1 * side / active / sets_in
    c = 1 / scale_r - side * s["roller_creep"] * side / active / scale_r**2
    c = -(s["roller_drag"] * h1 * c + s["roller_viscosity"])
    return traction, drag, load, d_load, a, b, c


def solve3(m, b):
    r0, r1, r2 = np.cross(m[:, 1], m[:, 2]), np.cross(m[:, 2], m[:, 0]), np.cross(m[:, 0], m[:, 1])
    det = (m[:, 0] * r0).sum(1, keepdims=True)
    return (r0 * b[:, :1] + r1 * b[:, 1:2] + r2 * b[:, 2:]) / det


def equilibrium(rim, hold, roll, pull, shift, s, rest, base):
    """Chord steps, then damped Newton, as slipid does it, with numpy's own idioms."""
    rows = np.array([1.0, 1.0, 1 / base])

    def force(xi):
        traction, drag, load, *more = terms(xi, rim, hold, roll, pull, shift, s, rest)
        f = (load * traction) @ hold + (load * drag) @ roll
        f[:, 2] -= s["scrub"][:, 0] * np.tanh(xi[:, 2] / contact.W0)
        return f * rows, traction, drag, load, *more

    def chord(xi):
        v = xi[:, :2]
        load = rest - s["lead"] * (v @ shift.T) / np.sqrt((v * v).sum(1, keepdims=True) + 1e-8)
        load = np.maximum(load, 1e-3)
        along, side = xi @ hold.T, xi @ roll.T
        active = np.sqrt(rim**2 + side**2 + 1e-12)

        def slope(x, scale):
            flat = np.abs(x) < 1e-6 * scale
            return np.where(flat, 1 / scale, np.tanh(x / scale) / np.where(flat, 1.0, x))

        pulls = slope(rim * pull - along, contact.V0 + s["creep"] * active) + s["slide_viscosity"]
        holds = s["roller_drag"] * slope(side, contact.VR + s["roller_creep"] * active)
        holds = load * (holds + s["roller_viscosity"])
        brakes = load * s["rolling_resistance"] * slope(along, contact.V0 + contact.S1 * active)
        m = (hold.T * (load * pulls + brakes)[:, None]) @ hold + (roll.T * holds[:, None]) @ roll
        m[:, 2, 2] += s["scrub"][:, 0] * slope(xi[:, 2], contact.W0)
        return solve3(m, (load * pulls * rim * pull) @ hold)

    def newton(xi):
        f, traction, drag, load, d_load, a, b, c = force(xi)
        d_t = (load * a)[..., None] * hold + (load * b)[..., None] * roll
        d_d = (load * c)[..., None] * roll
        d_t[..., :2] += traction[..., None] * d_load
        d_d[..., :2] += drag[..., None] * d_load
        jac = hold.T @ d_t + roll.T @ d_d
        turn = np.tanh(xi[:, 2] / contact.W0)
        jac[:, 2, 2] -= s["scrub"][:, 0] * (1 - turn**2) / contact.W0
        dx = solve3(rows[:, None] * jac, f)
        trials = np.stack([xi - alpha * dx for alpha in contact._DAMPING])
        merit = np.stack([(force(x)[0] ** 2).sum(1) for x in trials])
        best = merit.argmin(0)
        before = (f * f).sum(1)
        stuck = (merit.min(0) >= before) & (before > contact._ROUNDING)
        new = trials[best, np.arange(len(xi))]
        return np.where(stuck[:, None], chord(xi), new) if stuck.any() else new

    j = hold
    xi = 0.8 * np.linalg.solve(j.T @ j + 1e-6 * np.eye(3), j.T @ (rim * pull).T).T
    for _ in range(contact._CHORD_STEPS):
        xi = chord(xi)
    for _ in range(contact._NEWTON_STEPS):
        xi = newton(xi)
    return xi


# measurements --------------------------------------------------------------------------------


def test_residual_and_jacobian_against_numpy(problem):
    z, volt, rival = problem.space.start, jnp.asarray(1.0), Rival(problem)
    ours, (blocks, jacobian) = best_of(lambda: problem.linear(z, volt), 10)
    step = 1e-6
    moved = [numbers(problem.space.tree(jnp.asarray(z + step * e))) for e in np.eye(len(z))]
    here = numbers(problem.space.tree(jnp.asarray(z)))

    def differences():
        r = rival.residuals(here)
        return r, [{k: (x - r[k]) / step for k, x in rival.residuals(v).items()} for v in moved]

    theirs, (r, columns) = best_of(differences, 1)
    for k in blocks:
        np.testing.assert_allclose(blocks[k], r[k], atol=1e-8)
        numeric = np.stack([c[k] for c in columns], axis=-1)
        np.testing.assert_allclose(jacobian[k], numeric, atol=1e-3 * np.abs(numeric).max())
    what = "2022 logs" if DATA.is_dir() else "made data"
    print(
        f"\n{what}: {len(problem.windows)} pieces, {len(z)} parameters. Residual and Jacobian: "
        f"slipid {ours * 1e3:.0f} ms, numpy {theirs * 1e3:.0f} ms, ratio {theirs / ours:.1f}"
    )
    assert theirs > ours


def repeated(windows, times):
    """The same windows several times over, as of other runs."""

    def again(value):
        return np.concatenate([value] * times) if isinstance(value, np.ndarray) else value * times

    many = {
        f.name: again(getattr(windows, f.name))
        for f in fields(windows)
        if isinstance(getattr(windows, f.name), np.ndarray | tuple)
    }
    return replace(windows, **many)


def test_cost_is_linear_in_the_number_of_runs(problem):
    z, volt = problem.space.start, jnp.asarray(1.0)
    once = None
    for times in (1, 2, 4):
        more = problem.of(repeated(problem.windows, times))
        took, _ = best_of(lambda more=more: more.linear(z, volt), 5)
        once = once or took
        print(f"\n{times} x the runs: {took / once:.2f} x the time", end="")
    print()
    assert took < 8 * once


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no real logs: {DATA} is no folder")
def test_whole_2022_fit_cold_and_warm(tmp_path):
    """Two processes one after the other; the first finds an empty cache of compiled functions."""
    cache = {"SLIPID_CACHE": str(tmp_path), "PYTHONPATH": str(ROOT)}
    env = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")} | cache
    env["JAX_PLATFORMS"] = "cpu"
    for name in ("cold", "warm"):
        done = subprocess.run(
            [sys.executable, __file__], env=env, capture_output=True, text=True, check=True
        )
        took = json.loads(done.stdout.splitlines()[-1])
        print(f"\n{name}: " + ", ".join(f"{k} {v}" for k, v in took.items()), end="")
    print()
    assert took["converged"]


def main():
    """The whole 2022 fit, once, with the time of each stage."""
    began = time.perf_counter()
    from slipid.app import runtime
    from slipid.identify.fit import Options, optimise

    runtime.start()
    job = real_job()
    fit = job.config.content.fit
    read = time.perf_counter()
    problem = job.problem()
    optimum = optimise(problem, options=Options(fit.rounds, fit.tolerance))
    done = time.perf_counter()
    took = {
        "runs": len(job.dataset),
        "parameters": problem.space.size,
        "reading_s": round(read - began, 1),
        "fit_s": round(done - read, 1),
        "rounds": optimum.state.round,
        "converged": optimum.converged,
    }
    print(json.dumps(took))


if __name__ == "__main__":
    main()
