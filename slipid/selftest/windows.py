"""Windows as a robot with known numbers would have filled them, noise included.

Wheel motion, floors, loads, sessions and sampling are those of the windows given; poses, currents
and voltages are what the likelihood's own model makes of them. So a fit of the result shows what
this very experiment tells, and only what is wrong with the model itself is out of sight.
"""

from collections.abc import Mapping
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.data.windows import Windows
from slipid.identify.compare.open_loop import chain, corrected
from slipid.identify.fit import likelihood as lk
from slipid.identify.fit.noise import SHARED, axes, noise, travel
from slipid.identify.fit.shared import AXES, shared_of
from slipid.model.robot import Robot


def measure(
    truth: Robot, w: Windows, rng: np.random.Generator, std: Mapping[str, float]
) -> Windows:
    """The windows with poses, currents and voltages as a robot gives them, plus noise.

    Every piece starts at the pose it has. The scatter of the current is of the one that flows, and
    voltages follow it; `current_var` comes on top, is the ammeter's, and no voltage sees it.

    Args:
        truth: knows the floors, loads and sessions of the windows.
        w: what was driven; what it does not have is not made.
        std: of the variance components by name (`fit.noise`); a name without its floor stands for
            every floor, those left out are zero.
    """
    b = lk.batch(w, truth)
    increment, amps, start = (np.asarray(x) for x in _predicted(truth, b, jnp.asarray(w.pose)))
    steps = increment + _process(truth, w, rng, std)
    pose = np.array(_logged(truth, chain(jnp.asarray(start), jnp.asarray(steps))))
    pose[..., :2] += rng.normal(size=(*pose.shape[:2], 2)) * std.get("camera.place", 0.0)
    pose[..., 2] += rng.normal(size=pose.shape[:2]) * std.get("camera.heading", 0.0)
    each = _of(std, w, "current", "window")[:, None, None]
    of_run = rng.normal(size=(len(w), 1, amps.shape[2]))
    same = _of(std, w, "current", "run")[:, None, None] * of_run
    flowing = amps + same + each * rng.normal(size=amps.shape)
    speed = w.turn / w.dt[..., None]
    signed = flowing - float(truth.motor.current_offset)
    signed = signed if w.current_is_signed else signed * np.tanh(speed / 0.2)
    volts = np.asarray(truth.motor.voltage(jnp.asarray(signed), jnp.asarray(speed)))
    current = flowing + np.sqrt(w.current_var) * rng.normal(size=amps.shape)
    voltage = volts + rng.normal(size=amps.shape) * std.get("voltage.window", 0.0)
    return replace(
        w,
        pose=pose,
        current=current if w.has_current else np.zeros_like(current),
        voltage=voltage if w.has_voltage else np.zeros_like(voltage),
    )


@jax.jit
def _predicted(robot: Robot, b: lk.Batch, pose: Array) -> tuple[Array, Array, Array]:
    p = lk.predict(robot, b)
    return p.increment, lk.predicted_current(robot, b, p.felt), corrected(robot, pose)[:, 0]


@jax.jit
def _logged(robot: Robot, pose: Float[Array, "piece edge 3"]) -> Float[Array, "piece edge 3"]:
    return jax.vmap(jax.vmap(robot.camera.logged))(pose)


def _of(std: Mapping[str, float], w: Windows, kind: str, part: str) -> np.ndarray:
    """Std of a component of every piece, by its floor (piece,)."""
    usual = std.get(f"{kind}.{part}", 0.0)
    return np.array([std.get(f"{kind}.{floor}.{part}", usual) for floor in w.surface])


def _process(
    truth: Robot, w: Windows, rng: np.random.Generator, std: Mapping[str, float]
) -> Float[np.ndarray, "piece window 3"]:
    """Displacements that the model does not explain, growing with distance."""
    far, u = travel(w, truth)
    total, shared = np.zeros((*far.shape, 3)), _shared(truth, w, rng, std)
    for k, (axis, name) in enumerate(zip(axes(u), AXES, strict=True)):
        grown = _of(std, w, "process", name)[:, None] * np.sqrt(far)
        own = _of(std, w, "run", name) * rng.normal(size=len(w)) + shared[:, k]
        step = grown * rng.normal(size=far.shape) + own[:, None] * far
        total += (axis @ step[..., None]).reshape(total.shape)
    return total


def _shared(
    truth: Robot, w: Windows, rng: np.random.Generator, std: Mapping[str, float]
) -> Float[np.ndarray, "piece 3"]:
    """Effects that neighbouring runs, and runs of one session, share."""
    components = noise(w, truth)
    named = [
        std.get(c.name, std.get(f"{c.kind}.{c.what}", 0.0) if c.kind in SHARED else 0.0)
        for c in components.components
    ]
    log_v = jnp.asarray(2 * np.log(np.maximum(named, 1e-30)))
    out = np.zeros((len(w), len(AXES)))
    for of in shared_of(w, truth, components)[0]:
        root = np.asarray(of.root(log_v))
        drawn = np.einsum("anq,aq->na", root, rng.normal(size=root.shape[::2]))
        out[np.asarray(of.pieces)] = drawn
    return out
