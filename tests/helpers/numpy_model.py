"""slipid's model and likelihood once more, in vectorised numpy: what it is compared with."""

from __future__ import annotations

import math
from functools import reduce

import numpy as np
from scipy.linalg import solve_triangular

from slipid.fitting.likelihood import SMOOTHING_A
from slipid.fitting.variances import DEGREES
from slipid.model import contact, contact_law
from slipid.parameter import entries, share_basis


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
        self.turn, self.speed_change, self.direction, self.amps = (
            np.asarray(x).reshape(-1, x.shape[2])
            for x in (self.b.turn, self.b.speed_change, self.b.direction, self.b.current)
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

    def twist(self, v, near=None):
        """Body twists, and what they came from."""
        hold, roll, pull, shift = self.frame(v)
        late = v["camera", "lag"] - float(self.b.lag)
        speed = (self.turn - late * self.speed_change) / self.dt[:, None]
        rim = v["geometry", "wheel_radius"] * speed
        s = {k[1]: x[self.floor] for k, x in v.items() if k[0] == "surfaces"}
        rest = v["body", "load_share"][self.load] * np.exp(s.pop("load_bias"))
        rest = rest / rest.sum(axis=1, keepdims=True)
        s = {name: x[:, None] for name, x in s.items()}
        grown = (rest.shape[1] * rest) ** (s["drag_exponent"] - 1)
        s |= {name: s[name] * grown for name in ("roller_drag", "rolling_resistance")}
        base = v["geometry", "base_radius"]
        xi = equilibrium(rim, hold, roll, pull, shift, s, rest, base, near)
        return xi, (speed, rim, s, rest, hold, roll, pull, shift)

    def motion(self, v, xi):
        gap = self.seen(advance(xi, self.dt), v) - self.measured(v)
        return gap.reshape(len(self.b.dt), -1)

    def residuals(self, v):
        xi, (speed, rim, s, rest, hold, roll, pull, shift) = self.twist(v)
        traction, _, load, *_ = terms(xi, rim, hold, roll, pull, shift, s, rest)
        along, active = xi @ hold.T, np.sqrt(rim**2 + (xi @ roll.T) ** 2 + 1e-12)
        sets_in = contact_law.V0 + contact_law.S1 * active
        driven = (
            traction + s["rolling_resistance"] * saturated(along / sets_in, contact_law.KNEE)[0]
        )
        ratio = v["body", "mass_ratio"][self.load][:, None]
        weight = s["friction"] * v["body", "mass"] * ratio * 9.81
        m = {k[1]: x for k, x in v.items() if k[0] == "motor"}
        turns = rim * pull / active
        rolled = v["surfaces", "roller_drag"][self.floor][:, None] * turns * np.abs(turns)
        borne = load * driven + m["rolling_drag"] * rolled / rim.shape[1]
        steady = np.tanh(self.turn / self.dt[:, None] / 0.2)
        moving = np.linalg.norm(self.direction, axis=1) / np.linalg.norm(steady, axis=1)
        torque = v["geometry", "wheel_radius"] * weight * borne * np.minimum(moving, 1)[:, None]
        drag = m["coulomb_friction"] * self.direction + m["viscous_friction"] * speed
        amps = (torque + drag) / (self.g.gear_ratio * m["efficiency"] * m["back_emf"])
        amps = np.sqrt(amps**2 + SMOOTHING_A**2) if not self.b.signed else amps
        segments = len(self.b.dt)
        current = amps + m["current_offset"] - self.amps
        return {"motion": self.motion(v, xi), "current": current.reshape(segments, -1)}

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


def saturated(x, knee):
    """The root y of (1 - h^2) y^4 - (1 + x^2) y^2 + x^2 = 0, its slope, and y / x."""
    a, b = 1 - knee**2, 1 + x * x
    chord = np.sqrt(2 / (b + np.sqrt(b * b - 4 * a * x * x)))
    y = x * chord
    return y, (1 - y * y) / (chord * (b - 2 * a * y * y)), chord


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
    scale_t = contact_law.V0 + s["creep"] * active
    scale_r = contact_law.VR + s["roller_creep"] * active
    sets_in = contact_law.V0 + contact_law.S1 * active
    t, t1, _ = saturated(slide / scale_t, s["knee_width"])
    h, h1, _ = saturated(side / scale_r, s["knee_width"])
    u, u1, _ = saturated(along / sets_in, contact_law.KNEE)
    traction = t + s["slide_viscosity"] * slide - s["rolling_resistance"] * u
    drag = -(s["roller_drag"] * h + s["roller_viscosity"] * side)
    brake = s["rolling_resistance"] * u1 / sets_in
    a = -t1 / scale_t - s["slide_viscosity"] - brake
    b = -t1 * slide * s["creep"] * side / active / scale_t**2
    b = b + brake * along * contact_law.S1 * side / active / sets_in
    c = 1 / scale_r - side * s["roller_creep"] * side / active / scale_r**2
    c = -(s["roller_drag"] * h1 * c + s["roller_viscosity"])
    return traction, drag, load, d_load, a, b, c


def solve3(m, b):
    r0, r1, r2 = np.cross(m[:, 1], m[:, 2]), np.cross(m[:, 2], m[:, 0]), np.cross(m[:, 0], m[:, 1])
    det = (m[:, 0] * r0).sum(1, keepdims=True)
    return (r0 * b[:, :1] + r1 * b[:, 1:2] + r2 * b[:, 2:]) / det


def equilibrium(rim, hold, roll, pull, shift, s, rest, base, near=None):
    """Chord steps, then damped Newton, as slipid does it, with numpy's own idioms.

    Args:
        near: twists close to it, from which plain Newton steps arrive.
    """
    rows = np.array([1.0, 1.0, 1 / base])

    def force(xi):
        traction, drag, load, *more = terms(xi, rim, hold, roll, pull, shift, s, rest)
        f = (load * traction) @ hold + (load * drag) @ roll
        f[:, 2] -= s["scrub"][:, 0] * saturated(xi[:, 2] / contact_law.W0, contact_law.KNEE)[0]
        return f * rows, traction, drag, load, *more

    def chord(xi):
        v = xi[:, :2]
        load = rest - s["lead"] * (v @ shift.T) / np.sqrt((v * v).sum(1, keepdims=True) + 1e-8)
        load = np.maximum(load, 1e-3)
        along, side = xi @ hold.T, xi @ roll.T
        active = np.sqrt(rim**2 + side**2 + 1e-12)

        def slope(x, scale, knee=contact_law.KNEE):
            return saturated(x / scale, knee)[2] / scale

        knee = s["knee_width"]
        grips = slope(rim * pull - along, contact_law.V0 + s["creep"] * active, knee)
        pulls = grips + s["slide_viscosity"]
        holds = slope(side, contact_law.VR + s["roller_creep"] * active, knee)
        holds = load * (s["roller_drag"] * holds + s["roller_viscosity"])
        brakes = (
            load * s["rolling_resistance"] * slope(along, contact_law.V0 + contact_law.S1 * active)
        )
        m = (hold.T * (load * pulls + brakes)[:, None]) @ hold + (roll.T * holds[:, None]) @ roll
        m[:, 2, 2] += s["scrub"][:, 0] * slope(xi[:, 2], contact_law.W0)
        return solve3(m, (load * pulls * rim * pull) @ hold)

    def step(xi):
        f, traction, drag, load, d_load, a, b, c = force(xi)
        d_t = (load * a)[..., None] * hold + (load * b)[..., None] * roll
        d_d = (load * c)[..., None] * roll
        d_t[..., :2] += traction[..., None] * d_load
        d_d[..., :2] += drag[..., None] * d_load
        jac = hold.T @ d_t + roll.T @ d_d
        _, rise, _ = saturated(xi[:, 2] / contact_law.W0, contact_law.KNEE)
        jac[:, 2, 2] -= s["scrub"][:, 0] * rise / contact_law.W0
        return solve3(rows[:, None] * jac, f), f

    def newton(xi):
        dx, f = step(xi)
        trials = np.stack([xi - alpha * dx for alpha in contact._DAMPING])
        merit = np.stack([(force(x)[0] ** 2).sum(1) for x in trials])
        best = merit.argmin(0)
        before = (f * f).sum(1)
        stuck = (merit.min(0) >= before) & (before > contact._ROUNDING)
        new = trials[best, np.arange(len(xi))]
        return np.where(stuck[:, None], chord(xi), new) if stuck.any() else new

    if near is not None:
        for _ in range(contact._MOST_NEAR_STEPS):
            dx, _ = step(near)
            near = near - dx
            if np.abs(dx).max() < contact._CONVERGED_STEP:
                return near
    j = hold
    xi = 0.8 * np.linalg.solve(j.T @ j + 1e-6 * np.eye(3), j.T @ (rim * pull).T).T
    for _ in range(contact._CHORD_STEPS):
        xi = chord(xi)
    for _ in range(contact._NEWTON_STEPS):
        xi = newton(xi)
    return xi


class Posterior:
    """Log density of the motion as the `Density` has it, walker by walker, up to a constant.

    All windows are computed at once; `density` says where they are anchored.
    """

    def __init__(self, density):
        self.at, self.space = density.structure, density.problem.space
        self.rival, a = Rival(density.problem), density.anchor
        self.start, self.z = numbers(self.space.template), np.asarray(a.z)
        self.twist = np.asarray(a.twist).reshape(-1, 3)
        self.slope = np.asarray(a.twist_slope).reshape(-1, 3, len(self.z))
        self.root = np.asarray(a.root["motion"]) * np.asarray(a.scale["motion"])[:, None, None]
        self.pose = np.asarray(a.batch.pose)
        m = self.root.shape[-1]
        self.factor = (DEGREES + m) / (DEGREES + m + 2)  # of a Student t's information
        self.mean, self.std = self.space.prior_mean[self.at], np.asarray(a.prior_std)[self.at]
        self.tied = []
        for tie in a.effects:
            span, root = np.asarray(tie.span), np.asarray(tie.root)
            rows = np.einsum("nma,anq->nmaq", span, root).reshape(-1, root.shape[0] * root.shape[2])
            self.tied.append((np.asarray(tie.segments), rows, np.asarray(tie.factor)))

    def __call__(self, x):
        return np.array([self.one(row) for row in x])

    def one(self, x):
        z = self.z.copy()
        z[self.at] = x
        v = self.numbers(z)
        xi, _ = self.rival.twist(v, self.twist + self.slope @ (z - self.z))
        white = np.einsum("nij,nj->ni", self.root, self.rival.motion(v, xi))
        squares = (white**2).sum()
        for segments, rows, factor in self.tied:  # what shared effects explain
            squares -= (
                solve_triangular(factor, white[segments].ravel() @ rows, lower=True) ** 2
            ).sum()
        total = -0.5 * squares - 0.5 * (((x - self.mean) / self.std) ** 2).sum()
        total += self.factor * self.camera(v)
        return total if np.isfinite(total) else -np.inf

    def numbers(self, z):
        """Every number of the robot, in SI."""
        out = {k: v.copy() for k, v in self.start.items()}
        for e in self.space.free:
            mine, d = z[self.space.slices[e.path]], e.declaration
            if d.constrained:
                value = share_basis(len(mine) + 1) @ mine
                value = np.exp(value) / np.exp(value).sum() if d.shares else value
            elif math.isinf(d.upper):
                value = mine if math.isinf(d.lower) else d.lower + np.exp(mine)
            else:
                value = d.lower + (d.upper - d.lower) / (1 + np.exp(-mine))
            whole = out[e.leaf]
            place = ... if e.index is None else e.index
            whole[place] = value if whole[place].shape else value[0]
        return out

    def camera(self, v):
        """Log |d corrected / d logged| of all poses but the first of each piece."""
        pose = self.pose[:, 1:]
        q = pose[..., :2] - np.asarray(self.rival.camera.centre)
        k, h, p = (v["camera", name] for name in ("radial", "tilt", "tangential"))
        x, y = q[..., 0], q[..., 1]
        r2, pq, down = x * x + y * y, q @ p, 1 + q @ h
        bent = q * (1 + k * r2)[..., None] + p * r2[..., None] + 2 * q * pq[..., None]

        def slope(u):  # of the place, in a direction
            qu, pu = (q * u).sum(-1), (u * p).sum(-1)
            top = u * (1 + k * r2)[..., None] + 2 * (k * qu)[..., None] * q
            top = top + 2 * qu[..., None] * p + 2 * u * pq[..., None] + 2 * q * pu[..., None]
            top = top / down[..., None] - bent * ((u * h).sum(-1) / down**2)[..., None]
            return v["camera", "scale"] * top

        a, b = slope(np.array([1.0, 0.0])), slope(np.array([0.0, 1.0]))
        turned = slope(np.stack([np.cos(pose[..., 2]), np.sin(pose[..., 2])], axis=-1))
        area = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
        return (2 * np.log(area) - np.log((turned**2).sum(-1))).sum()
