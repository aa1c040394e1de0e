"""Controllers: from where the robot should be and what is estimated to wheel speed commands.

All share one interface, `init() -> state` and `step(state, reference, estimate, dt) -> (state,
wheel speeds)`, one limiter that keeps the direction of motion, and one safe stop. They differ in
what they do beyond the pose loop

    v = R(-heading) (v_ref + k (p_ref - p)),   W = W_ref + k_yaw sin(heading_ref - heading)
"""

from dataclasses import dataclass
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.control.estimator import UNTIMED_S, estimated
from slipid.control.frozen import Frozen
from slipid.control.packed import Layout
from slipid.model import contact

Correction = Literal["none", "torque", "paper_print", "paper_code"]
GAINS = ("place", "yaw", "integral", "ahead", "observer", "preview")
"""Pose loop [1/s], heading loop [1/s], integral of the pose error [1/s^2], share of the inverse
model in the wheel speeds [1], disturbance observer [1], time by which the path's rates are asked
for early, because wheels follow late [s]."""
AHEAD = GAINS.index("ahead")
PAPER_GAIN = {"x": (3000.0, 500.0, 3000.0), "y": (2000.0, 2000.0, 2000.0)}
"""Of the 2021 paper's torque correction, motor rpm per N m at the motor shaft, by leg."""
OBSERVE_S = 0.4
"""Time constant of the disturbance observer [s]."""
LONGEST_I = 0.06
"""Largest velocity the integral may ask for [m/s]."""
_PASSES = 3
"""Of the inverse model; 99 % of twists are then met within 0.1 mm/s, with one within 10 mm/s."""


@dataclass(frozen=True)
class Limits:
    """What a command may not exceed.

    Attributes:
        wheel_speed: [rad/s]; acceleration: of a wheel [rad/s^2].
        voltage: of the supply [V].
        twist: largest speed asked of the body [m/s].
    """

    wheel_speed: float = 13.0
    acceleration: float = 25.0
    voltage: float = 22.0
    twist: float = 0.5


def _known_zero(gains: Any, place: int) -> bool:
    """Whether a gain is a constant of the compiled code, and zero: what it weighs is left out."""
    if isinstance(gains, jax.core.Tracer):
        return False
    return float(np.asarray(gains)[place]) == 0.0


def limited(
    wanted: Float[Array, " wheel"],
    before: Float[Array, " wheel"],
    current: Float[Array, " wheel"],
    frozen: Frozen,
    limits: Limits,
    dt: Float[Array, ""] | float,
) -> Float[Array, " wheel"]:
    """Wheel speeds within all limits, scaled together so that the robot keeps its direction.

    Speed and voltage scale the command, U = R |I| + n C_e |w| at most the supply's; acceleration
    scales the change from the last command. Never NaN.

    Args:
        wanted: [rad/s].
        before: last command [rad/s].
        current: of the motors, for what is left of the supply [A].
        frozen: the motor's numbers.
        limits: what is allowed.
        dt: since the last command [s].
    """
    motor = frozen.motor
    wanted = jnp.where(jnp.all(jnp.isfinite(wanted)), wanted, 0.0)
    before = jnp.where(jnp.isfinite(before), before, 0.0)
    dt = jnp.where(jnp.isfinite(jnp.asarray(dt)) & (jnp.asarray(dt) > 0), dt, 0.0)
    drop = motor.resistance * jnp.abs(jnp.where(jnp.isfinite(current), current, 0.0))
    left = jnp.maximum(limits.voltage - drop, 0.2 * limits.voltage)
    most = jnp.minimum(limits.wheel_speed, left / (motor.gear_ratio * motor.back_emf))
    over = jnp.max(jnp.abs(wanted) / most)
    wanted = wanted / jnp.maximum(over, 1.0)
    step = wanted - before
    allowed = limits.acceleration * jnp.minimum(dt, 0.5)
    size = jnp.max(jnp.abs(step))
    out = before + step * jnp.where(size > allowed, allowed / jnp.maximum(size, 1e-9), 1.0)
    return jnp.clip(out, -limits.wheel_speed, limits.wheel_speed)


def inverse_contact(
    frozen: Frozen, xi: Float[Array, "3"], surface: Float[Array, "wheel floor"]
) -> Float[Array, " wheel"]:
    """Wheel speeds at which the contact forces balance at a wanted twist [rad/s].

    The twist fixes roller speeds and so drag; balance gives the tractions, least ones beyond three
    wheels; each traction gives the sliding speed of its wheel on its floor:

        T = -(J^T)^+ (K^T D(xi) + scrub),   r w = J xi + (v0 + s0 c) atanh(T / N)

    weighted by the probability of every floor. A traction above 0.9 of what the floor holds is
    taken for 0.9. Drag falls with the rim speed, and so with the sliding that it causes: each pass
    goes by the last one's.

    Args:
        frozen: the identified robot.
        xi: wanted twist [m/s, m/s, rad/s].
        surface: probability of each floor under each wheel, sums 1.

    Source: `slipid.model.contact`, solved for the wheels; rollers at right angles.
    """
    f, s = frozen.frame, frozen.floors
    size = jnp.sqrt(xi[:2] @ xi[:2] + 1e-8)
    lead = frozen.rest @ (surface @ s.lead)
    load = jnp.maximum(frozen.rest - lead * (f.shift @ (xi[:2] / size)), 0.02)
    along, roll = (f.hold @ xi)[:, None], (f.roll @ xi)[:, None]
    mu = load[:, None] * s.friction  # (wheel, floor): forces in units of m g
    scrub = jnp.mean(surface @ s.friction) * (frozen.rest @ (surface @ s.scrub))
    scrub = scrub * jnp.tanh(xi[2] / contact.W0)
    slide = jnp.zeros_like(mu)
    for _ in range(_PASSES):
        active = jnp.sqrt((along + slide) ** 2 + roll**2 + 1e-12)
        drag = s.roller_drag * jnp.tanh(roll / (contact.VR + s.roller_creep * active))
        drag = -mu * (drag + s.roller_viscosity * roll)
        brake = jnp.tanh(along / (contact.V0 + contact.S1 * active))
        brake = mu * s.rolling_resistance * brake
        total = (f.roll.T @ jnp.sum(surface * drag, axis=1)).at[2].add(-scrub)
        pull = jnp.sum(surface * brake, axis=1) - frozen.inverse.T @ total
        slide = _sliding(pull[:, None] / mu - s.slide_viscosity * slide, along, roll, s.creep)
    return (along[:, 0] + jnp.sum(surface * slide, axis=1)) / f.radius


def _sliding(ratio: Array, along: Array, roll: Array, creep: Array) -> Array:
    """Sliding speed at which a wheel has so much of its traction [m/s].

    vs = (v0 + s0 c) atanh(ratio) with c^2 = (along + vs)^2 + roll^2, a quadratic in the rim speed;
    which has no root where s0 atanh(ratio) reaches 1: the wheel spins on the spot.
    """
    held = jnp.arctanh(jnp.clip(ratio, -0.9, 0.9))
    k = jnp.clip(creep * held, -0.9, 0.9)
    at = along + contact.V0 * held
    left = 1 - k * k
    return (at + k * jnp.sqrt(at**2 + left * roll**2 + 1e-12)) / left - along


class Controller(eqx.Module):
    """Pose loop with whatever a row of the trial adds to it.

    Attributes:
        frozen: the identified robot.
        gains: of `GAINS`, in their order.
        limits: of the commands.
        correction: torque correction of the 2021 paper, in the form it prints, the form its authors
            ran, or corrected.
    """

    frozen: Frozen
    gains: Float[Array, " gain"]
    limits: Limits = eqx.field(static=True, default=Limits())
    correction: Correction = eqx.field(static=True, default="none")

    def __check_init__(self) -> None:
        shape = getattr(self.gains, "shape", (len(GAINS),))  # JAX also puts other things there
        if shape[-1:] != (len(GAINS),):
            raise ValueError(f"gains of shape {shape}; expected {len(GAINS)}: {', '.join(GAINS)}")

    @property
    def _kept(self) -> Layout:
        w = (self.frozen.wheels,)
        fields = (("command", w), ("integral", (2,)), ("wanted", (3,)), ("miss", (3,)))
        return Layout((*fields, ("begun", ())))

    @property
    def estimated(self) -> Layout:
        """Layout of the estimate it reads."""
        return estimated(self.frozen.wheels, len(self.frozen.labels))

    def init(self) -> Float[Array, " state"]:
        """State of a controller that has commanded nothing yet."""
        zero = jnp.zeros(self.frozen.wheels)
        return self._kept.pack(
            command=zero, integral=jnp.zeros(2), wanted=jnp.zeros(3), miss=jnp.zeros(3), begun=0.0
        )

    def step(
        self,
        state: Float[Array, " state"],
        reference: Float[Array, "6"],
        estimate: Float[Array, " estimated"],
        dt: Float[Array, ""] | float,
    ) -> tuple[Float[Array, " state"], Float[Array, " wheel"]]:
        """Wheel speeds to command [rad/s].

        Stops, at the allowed deceleration, while the estimate is stale or anything is no number;
        starts from the speed the wheels have.

        Args:
            state: from `init` or the last step.
            reference: pose and rates in the world, `slipid.control.reference.Path.at`.
            estimate: as an estimator lays it out.
            dt: since the last step [s].
        """
        f, old, e = self.frozen, self._kept.of(state), self.estimated.of(estimate)
        place, yaw, integral, _, observer, _ = self.gains
        safe = jnp.all(jnp.isfinite(estimate)) & jnp.all(jnp.isfinite(reference)) & (e.stale < 0.5)
        pose = jnp.where(safe, e.pose, 0.0)
        ref = jnp.where(safe, reference, 0.0)
        dt = jnp.asarray(dt, dtype=float)
        dt = jnp.where(jnp.isfinite(dt) & (dt > 0), jnp.minimum(dt, 0.5), 0.0)
        gap = ref[:2] - pose[:2]
        v = ref[3:5] + place * gap + old.integral
        c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
        turn = ref[5] + yaw * jnp.sin(ref[2] - pose[2])
        wanted = jnp.stack([c * v[0] + s * v[1], c * v[1] - s * v[0], turn])
        fast = jnp.sqrt(wanted[:2] @ wanted[:2] + 1e-12) / self.limits.twist
        wanted = wanted.at[:2].divide(jnp.maximum(fast, 1.0))
        # what the robot does less what it was asked to do, as far as the estimator sees it
        twist = jnp.where(safe, e.twist, 0.0)
        a = 1 - jnp.exp(-dt / OBSERVE_S)
        miss = old.miss + a * (twist - old.wanted - old.miss)
        asked = wanted - observer * miss
        wheels = self._wheels(asked, e)
        wheels = wheels + self._torque(wanted, e)
        before = jnp.where(old.begun > 0.5, old.command, jnp.where(safe, e.wheel_speed, 0.0))
        wheels = jnp.where(safe, wheels, 0.0)
        since = jnp.where(safe, dt, jnp.maximum(dt, UNTIMED_S))
        command = limited(wheels, before, e.current, f, self.limits, since)
        free = safe & (jnp.max(jnp.abs(command - wheels)) < 0.05)  # the integral rests at a limit
        summed = jnp.clip(old.integral + integral * gap * dt, -LONGEST_I, LONGEST_I)
        state = self._kept.pack(
            command=command,
            integral=jnp.where(free, summed, jnp.where(safe, old.integral, 0.0)),
            wanted=jnp.where(safe, asked, 0.0),
            miss=jnp.where(safe, jnp.clip(miss, -0.2, 0.2), 0.0),
            begun=1.0,
        )
        return state, command

    def _wheels(self, asked: Array, e: Any) -> Array:
        """Wheel speeds for a twist: a share of the inverse model, the rest kinematics.

        Mecanum wheels, whose inverse model is another, go by kinematics alone.
        """
        f = self.frozen
        plain = f.forward @ asked / f.frame.radius
        if _known_zero(self.gains, AHEAD):
            return plain
        share = e.surface[:, :-1]
        total = jnp.sum(share, axis=1, keepdims=True)
        known = jnp.where(total > 1e-3, share / jnp.maximum(total, 1e-3), 0.0)
        known = jnp.where(jnp.isfinite(known), known, 0.0)
        moves = jnp.clip(jnp.max(jnp.abs(plain)) * f.frame.radius / 0.02 - 0.25, 0.0, 1.0)
        right = jnp.all(jnp.abs(f.frame.slip_through) < 1e-9)  # rollers at right angles
        extra = inverse_contact(f, asked, known) - plain
        extra = jnp.where(right & (total[:, 0] > 1e-3), extra, 0.0)
        return plain + self.gains[AHEAD] * moves * (1 - e.surface[0, -1]) * extra

    def _torque(self, wanted: Array, e: Any) -> Array:
        """The 2021 paper's correction by the forces off the commanded direction [rad/s]."""
        if self.correction == "none":
            return jnp.zeros(self.frozen.wheels)
        f = self.frozen
        turning = jnp.where(jnp.abs(e.wheel_speed) > 0.1, jnp.sign(e.wheel_speed), 0.0)
        torque = f.motor.characteristic(jnp.abs(e.current) * turning, e.wheel_speed)
        force = f.forward.T @ torque / f.frame.radius
        along_x = jnp.abs(wanted[0]) >= jnp.abs(wanted[1])
        gain = jnp.where(along_x, jnp.asarray(PAPER_GAIN["x"]), jnp.asarray(PAPER_GAIN["y"]))
        if self.correction == "paper_code":
            on_x, on_y = jnp.array([0.0, -1.0, -1.0]), jnp.array([1.0, 0.0, 1.0])
            off = jnp.where(along_x, on_x, on_y) * force
        else:
            u = wanted[:2] / jnp.sqrt(wanted[:2] @ wanted[:2] + 1e-8)
            straight = jnp.abs(wanted[2]) < 0.05
            off = (
                force.at[:2].add(-(force[:2] @ u) * u).at[2].multiply(jnp.where(straight, 1.0, 0.0))
            )
        if self.correction == "torque":
            moment = f.frame.radius * f.inverse.T @ off
        else:  # as printed: the lever is divided by, not multiplied
            printed = f.forward.at[:, 2].divide(f.frame.base**2)
            moment = f.frame.radius * printed @ off
        moves = jnp.max(jnp.abs(e.wheel_speed)) > 0.5
        rpm = jnp.where(moves, gain * moment, 0.0)
        return rpm * (2 * np.pi / 60) / f.motor.gear_ratio
