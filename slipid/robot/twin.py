"""The twin: the identified model of a robot as a plant for closed-loop runs.

Commands reach the drives with a delay, a limited acceleration and a lag. The body moves by the
contact model with the floor under each wheel, or by the calibrated kinematics of a floor for which
they were selected, while all wheels are on it. The errors of the model are drawn at random for
every run, with effects as in `slipid.robot.filter.effects`:

    set <- set + clip(command(t - delay) - set, slew h),   w <- w + (1 - exp(-h / lag)) (set - w)
    xi = equilibrium(r w; floor under each wheel)  or  kinematics w
    pose <- pose * exp(xi h + s h (estimated + remaining effect) + sqrt(s h) process)

with h the substep [s], `set` the set-point speeds of the drives' speed control and w the wheel
speeds of the drives [rad/s], r the wheel radius [m], xi the body twist [m/s, m/s, rad/s] and s the
speed of the body if no wheel slipped [m/s].

Everything is differentiable except for the choice of the floor under a wheel; derivatives ignore
the quantization of encoders. Use forward mode (`jax.jvp`, `jax.jacfwd`), since NaN readings would
make the derivatives of reverse mode NaN.
"""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.model.motor import sign_of_motion
from slipid.model.se2 import advance, compose
from slipid.parameter import as_numbers
from slipid.robot.deployed import RobotArrays
from slipid.robot.filter.effects import RolledMotion, effect_correlation, travel_direction
from slipid.robot.filter.floor import Floor
from slipid.robot.interface import PERIOD, Measurement, Pose, Readings

KEPT_COMMANDS = 6
"""Number of commands that are kept, including the newest."""
LONGEST_DELAY_S = (KEPT_COMMANDS - 1) * PERIOD
"""Longest delay of a twin [s]."""


@dataclass(frozen=True)
class ActuatorModel:
    """Response of the wheels to commands, and noise of the sensors; neither is fitted.

    Attributes:
        delay_s: time until a command reaches the wheels [s].
        slew: largest acceleration of the wheels [rad/s^2].
        lag_s: time constant of the wheels' speed control [s].
        ticks: encoder ticks per turn of the wheel.
        ammeter_a: std of the noise of a measured current [A].
        drift_s: correlation time of the errors of modelled currents [s].
        voltmeter_v: std of the noise of a measured voltage [V].
        voltage: True if voltages are measured.
        gyro_noise: std of the noise of a measured yaw rate [rad/s].
        gyro_bias: std of the bias of a measured yaw rate [rad/s].
        gyro: True if yaw rates are measured.
        signed: True if measured currents have signs.
        substeps: number of simulation steps of wheels and body in a control period.
        smooth: True for ideal encoders without ticks, which measure angles exactly.
    """

    delay_s: float = 0.12
    slew: float = 25.0
    lag_s: float = 0.03
    ticks: float = 32000.0
    ammeter_a: float = 0.05
    drift_s: float = 0.1
    voltmeter_v: float = 0.05
    voltage: bool = True
    gyro_noise: float = 0.004
    gyro_bias: float = 0.005
    gyro: bool = False
    signed: bool = False
    substeps: int = 2
    smooth: bool = False

    @property
    def substep(self) -> float:
        """Duration of a substep [s]."""
        return PERIOD / self.substeps

    @property
    def lag_gain(self) -> float:
        """Fraction of the gap between set-point and wheel speed that a substep closes [1]."""
        return 1 - float(np.exp(-self.substep / max(self.lag_s, 1e-6)))

    def command_weights(self) -> Float[np.ndarray, "substep command"]:
        """Return the weights of the last commands, newest first, in the mean command of a substep.

        A command holds for a period and reaches the wheels after the delay. A weight is the
        fraction of the substep in which that command acts; it is piecewise linear in the delay.
        """
        h = self.substep
        begin = np.arange(self.substeps)[:, None] * h - self.delay_s
        since = -np.arange(KEPT_COMMANDS)[None, :] * PERIOD
        both = np.minimum(begin + h, since + PERIOD) - np.maximum(begin, since)
        share = np.clip(both, 0.0, None) / h
        # give the remaining weight, of commands that are no longer kept, to the oldest kept one
        share[:, -1] += 1.0 - share.sum(axis=1)
        return share


class TwinState(eqx.Module):
    """True state of a twin.

    Attributes:
        pose: x, y [m], heading [rad].
        twist: velocity of the body in its own axes [m/s, m/s, rad/s].
        wanted: set-point speeds of the drives' speed control [rad/s].
        speed: speed of the wheels of each drive [rad/s].
        angle: angle of the wheels of each drive [rad].
        effect: present effect of every floor less its estimate, in units of the remaining std.
        toward: settled direction of travel, see `slipid.robot.filter.effects`.
        offset: error of the modelled currents that is constant in a run [A].
        drift: error of the modelled currents that is correlated over time [A].
        bias: bias of the gyro [rad/s].
        ring: last commands, the newest first [rad/s]; the newest have not reached the wheels yet.
    """

    pose: Float[Array, "3"]
    twist: Float[Array, "3"]
    wanted: Float[Array, " drive"]
    speed: Float[Array, " drive"]
    angle: Float[Array, " drive"]
    effect: Float[Array, "floor 3"]
    toward: Float[Array, "3"]
    offset: Float[Array, " drive"]
    drift: Float[Array, " drive"]
    bias: Float[Array, ""]
    ring: Float[Array, "command drive"]


class Twin(eqx.Module):
    """A robot on a floor map, simulated by its own identified model.

    Attributes:
        robot: robot with its true parameters.
        floor: map of the surfaces, numbered as in `robot.labels`.
        actuators: response of the wheels and noise of the sensors.
    """

    robot: RobotArrays = eqx.field(converter=lambda robot: robot.arrays)
    floor: Floor
    actuators: ActuatorModel = eqx.field(static=True, default=ActuatorModel())

    def __check_init__(self) -> None:
        """Raise `ValueError` for a delay below 0 or above `LONGEST_DELAY_S`."""
        if not 0 <= self.actuators.delay_s <= LONGEST_DELAY_S:
            raise ValueError(
                f"delay_s = {self.actuators.delay_s}; expected a delay from 0 to "
                f"{LONGEST_DELAY_S:g} s"
            )

    def noise(self, key: Array, number: Array | int) -> Float[Array, " noise"]:
        """Return the standard normal random numbers of a step; `number` is 0 for `first`."""
        count = 3 * (self.robot.drives + self.actuators.substeps + len(self.robot.labels)) + 1
        return jax.random.normal(jax.random.fold_in(key, number), (count,))

    def init(self, pose: Pose, key: Array) -> TwinState:
        """Return the state at rest at a pose [m, m, rad]; `key` draws the errors of this run."""
        f, w = self.robot, (self.robot.drives,)
        one, two, three = jax.random.split(jax.random.fold_in(key, 2**31 - 1), 3)
        off = jax.random.normal(two, w) * jnp.mean(f.current_std) / jnp.sqrt(2.0)
        zero = jnp.zeros(w)
        return TwinState(
            pose=jnp.asarray(pose, dtype=float),
            twist=jnp.zeros(3),
            wanted=zero,
            speed=zero,
            angle=zero,
            effect=jax.random.normal(one, f.effect.shape),
            toward=jnp.zeros(3),
            offset=off,
            drift=zero,
            bias=self.actuators.gyro_bias * jax.random.normal(three),
            ring=jnp.zeros((KEPT_COMMANDS, *w)),
        )

    def step(
        self, state: TwinState, command: Float[Array, " drive"], noise: Float[Array, " noise"]
    ) -> tuple[TwinState, Readings]:
        """Return state and readings one control period after a command [rad/s] is given."""
        old, b, h = state, self.actuators, self.actuators.substep
        ring = jnp.concatenate([command[None], old.ring[:-1]])
        shares = jnp.asarray(b.command_weights())
        pushes = noise[: 3 * b.substeps].reshape(-1, 3)
        pose, xi, wanted, w, angle = old.pose, old.twist, old.wanted, old.speed, old.angle
        for k in range(b.substeps):
            jump = b.slew * h
            wanted = wanted + jnp.clip(shares[k] @ ring - wanted, -jump, jump)
            w = w + b.lag_gain * (wanted - w)
            pose, xi = self._roll(pose, w, old.effect, pushes[k], h)
            angle = angle + h * w
        now = replace(old, pose=pose, twist=xi, wanted=wanted, speed=w, angle=angle, ring=ring)
        amps, drift = self._currents(now, noise[3 * b.substeps :])
        turned = (pose[2] - old.pose[2]) / PERIOD
        effect, toward = self._effects(now, noise[-3 * len(self.robot.labels) :])
        now = replace(now, drift=drift, effect=effect, toward=toward)
        return now, self._read(angle, w, amps, turned + old.bias, noise)

    def first(self, state: TwinState, noise: Array) -> Readings:
        """Return the readings at rest, before the first command."""
        still = jnp.zeros_like(state.speed)
        return self._read(state.angle, state.speed, still, state.bias, noise)

    def _roll(
        self, pose: Array, w: Array, effect: Array, push: Array, h: float
    ) -> tuple[Array, Array]:
        """Return the pose one substep later, and the twist by the model of the floors.

        The pose also moves by the effects and by the random errors of the floors under the wheels.
        """
        f = self.robot
        under = self.floor.under(pose, f.places)
        xi = self._twist(under, w)
        rolled = RolledMotion.of(f.inverse @ (f.frame.radius * w), f.frame.base)
        mean, part = f.effect_table.at(rolled)
        errors, far, share = mean + part * f.effect * effect, rolled.speed * h, f.rest[:, None]
        off = far * jnp.sum(share * errors[under], axis=0)
        off += jnp.sqrt(far + 1e-12) * push * jnp.sqrt(jnp.sum(share * f.process[under] ** 2, 0))
        return compose(pose, advance(xi + rolled.axes @ off / h, h)), xi

    def _twist(self, under: Array, w: Array) -> Array:
        """Return the body twist at wheel speeds `w` on the floors `under` the wheels."""
        f = self.robot
        xi = f.standing(under).twist(f.at_wheels(w))
        if not any(f.calibrated):
            return xi
        uses = jnp.all(under == under[0]) & jnp.asarray(f.calibrated)[under[0]]
        return jnp.where(uses, f.kinematics[under[0]] @ w, xi)

    def _effects(self, now: TwinState, noise: Array) -> tuple[Array, Array]:
        """Return the floors' effects and the settled direction for the next control period."""
        f, xi = self.robot, now.twist
        far = (jnp.sqrt(xi[:2] @ xi[:2] + 1e-12) + f.frame.base * jnp.abs(xi[2])) * PERIOD
        under = self.floor.under(now.pose, f.places)
        left = jnp.all(under[:, None] != jnp.arange(len(f.labels)), axis=0)
        heading = travel_direction(f.inverse @ (f.frame.radius * now.speed), f.frame.base)
        toward, keep = effect_correlation(now.toward, heading, left.astype(float), far)
        fresh = jnp.sqrt(1 - keep**2 + 1e-15)[:, None] * noise.reshape(-1, 3)
        return keep[:, None] * now.effect + fresh, toward

    def _currents(self, now: TwinState, noise: Array) -> tuple[Array, Array]:
        """Return signed currents [A], and the new value of their correlated errors [A]."""
        f, drives, xi, w = self.robot, self.robot.drives, now.twist, now.speed
        under = self.floor.under(now.pose, f.places)
        keep = float(np.exp(-PERIOD / self.actuators.drift_s))
        std = f.on_average(f.current_std[under])
        fresh = jnp.sqrt((1 - keep**2) / 2.0) * std * noise[:drives]
        drift = keep * now.drift + fresh
        # a motor at standstill draws no current, so the errors fade out there as well
        moves = sign_of_motion(w) ** 2
        model = f.standing(under).current(xi, w)
        free = (f.inverse @ (f.frame.radius * w))[:2]
        more = f.current_trend @ jnp.stack([1.0, jnp.sqrt(free @ free + 1e-24)])
        return model + moves * (jnp.sign(model) * more + now.offset + drift), drift

    def _read(self, angle: Array, w: Array, amps: Array, turn: Array, noise: Array) -> Readings:
        """Return noisy readings, with NaN for all quantities that the robot does not measure."""
        b, drives = self.actuators, self.robot.drives
        _, by_amps, by_volts, by_turn = jnp.split(
            noise[3 * b.substeps :], [drives, 2 * drives, 3 * drives]
        )
        tick = 2 * np.pi / b.ticks
        whole = jax.lax.stop_gradient(jnp.floor(angle / tick) * tick - angle)
        read = amps + self.robot.motor.current_offset + b.ammeter_a * by_amps
        volts = self.robot.motor.voltage(amps, w) + b.voltmeter_v * by_volts
        return Measurement(
            wheel_angle=angle if b.smooth else angle + whole,
            current=read if b.signed else jnp.abs(read),
            voltage=volts if b.voltage else None,
            gyro=turn + b.gyro_noise * by_turn[0] if b.gyro else None,
        ).filled(drives)


class TwinPlant:
    """A twin as a `slipid.robot.closed_loop.Plant`; equal random keys give equal runs."""

    def __init__(self, twin: Twin, start: Pose, key: Array):
        self.twin, self.start, self.key = twin, as_numbers(start), key
        self.reset()

    def reset(self) -> Readings:
        self._count = 0
        self._state, reading = _first_step(self.twin, self.start, self.key)
        return reading

    def step(self, wheel_speed: Float[np.ndarray, " drive"]) -> Readings:
        self._count += 1
        command, count = jnp.asarray(wheel_speed), jnp.asarray(self._count)
        self._state, reading = _stepped(self.twin, self._state, command, self.key, count)
        return reading

    @property
    def pose(self) -> tuple[float, float, float]:
        x, y, heading = np.asarray(self._state.pose).tolist()
        return x, y, heading


@eqx.filter_jit
def _first_step(twin: Twin, start: Array, key: Array) -> tuple[TwinState, Readings]:
    state = twin.init(start, key)
    return state, twin.first(state, twin.noise(key, 0))


@eqx.filter_jit
def _stepped(
    twin: Twin, state: TwinState, command: Array, key: Array, count: Array
) -> tuple[TwinState, Readings]:
    return twin.step(state, command, twin.noise(key, count))
