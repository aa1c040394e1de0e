"""Slip, surface and pose from wheel speed and current: a filter over which floor each wheel is on.

A robot whose wheels stand on several floors moves as one body, so every hypothesis is one floor per
wheel, all of them together (27 with three wheels on three floors), and one that says "unknown":

    xi_c, I_c     contact equilibrium and motor currents of hypothesis c at the wheel speeds
    p_c <- p_c * (p(I | I_c) p(gyro | xi_c))^(dt / tau)   once wheels may be on other floors
    xi = sum_c p_c xi_c,   pose <- pose * exp(xi dt)

A wheel's current shows its share of the whole drag, not the drag beneath it; only together do they
tell the floors. What the fit says the model misses (process noise, effects that stay) is carried
along as the covariance of the pose, with a gyro's bias and the effects as further unknowns that
pose fixes and rest correct.
"""

import itertools
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.control.frozen import Frozen
from slipid.control.packed import Layout
from slipid.model.robot import GRAVITY, advance, compose
from slipid.model.settle import combine, settle

MIXED = 1.0
"""`Settings.alike` of a robot that is known to drive across the edges of floors."""
UNTIMED_S = 0.01
"""What a step without a time counts as, until readings are stale and while the robot stops [s]."""
HISTORY = 48
"""Steps a delayed measurement may reach back."""
HASTE = 30.0
"""Wheel acceleration from which inertia, which the equilibrium lacks, hides floors [rad/s^2]."""
FLAGS = ("stale", "immobilised", "out_of_range")


def sensed(wheels: int) -> Layout:
    """What sensors give in one step; NaN where there is nothing.

    wheel_angle [rad], cumulative, or wheel_speed [rad/s] (the angle comes first); current [A];
    voltage [V]; gyro, yaw rate [rad/s]; fix: x, y [m], heading [rad]; fix_std [m], [rad];
    fix_age [s].
    """
    w = (wheels,)
    names = ("wheel_angle", "wheel_speed", "current", "voltage")
    rest = (("gyro", ()), ("fix", (3,)), ("fix_std", (2,)), ("fix_age", ()))
    return Layout((*((name, w) for name in names), *rest))


def estimated(wheels: int, floors: int) -> Layout:
    """What an estimator says; flags are 0 or 1.

    pose [m, m, rad]; twist of the body [m/s, m/s, rad/s]; slip, ratio of each wheel; wheel_speed
    [rad/s]; current, signed, filtered [A]; surface, probability of each floor and of none of them
    under each wheel (wheel, floor + 1); covariance of the pose in the world frame; stale: wheels
    are not heard; immobilised; out_of_range: faster, or drawing more, than the fit has seen, or on
    a floor it does not know.
    """
    w = (wheels,)
    return Layout(
        (
            ("pose", (3,)),
            ("twist", (3,)),
            ("slip", w),
            ("wheel_speed", w),
            ("current", w),
            ("surface", (wheels, floors + 1)),
            ("covariance", (3, 3)),
            *((flag, ()) for flag in FLAGS),
        )
    )


@dataclass(frozen=True)
class Settings:
    """What is not identified.

    Attributes:
        current_is_signed: of the ammeters.
        forget_s: currents nearer than this in time tell the same twice [s].
        filter_s: time constant in which currents are averaged [s].
        patch_m: length on which the floor under a wheel changes.
        alike: how much rarer each further floor under the robot is, in log probability.
        unknown_std: from what it predicts, in stds of a current, a hypothesis loses to "unknown".
        ammeter_std_a, voltmeter_std_v: of the sensors.
        gyro_std, gyro_bias_std: of a reading and of its zero [rad/s].
        gyro_delay_s: age of its readings [s].
        still_m_s: rim speed below which the robot stands [m/s].
        stale_s: without a wheel's reading after which it is stale [s].
        longest_s: time step beyond which the robot's motion is not made up [s].
    """

    current_is_signed: bool = False
    forget_s: float = 0.4
    filter_s: float = 0.05
    patch_m: float = 0.1
    alike: float = 3.0
    unknown_std: float = 3.0
    ammeter_std_a: float = 0.07
    voltmeter_std_v: float = 0.06
    gyro_std: float = 0.004
    gyro_bias_std: float = 0.01
    gyro_delay_s: float = 0.0
    still_m_s: float = 0.003
    stale_s: float = 0.3
    longest_s: float = 0.5


def read_wheels(
    frozen: Frozen, settings: Settings, old: Any, z: Any, dt: Array
) -> tuple[Array, Array, Array]:
    """Wheel speeds, angles up to which motion is counted, and how old each wheel's reading is.

    A wheel that is not heard keeps its speed until it is stale, then it counts as standing; when it
    is heard again, what it has turned more than was counted is made up for.
    """
    most = 4.0 * frozen.highest[0]
    turned = (z.wheel_angle - old.angle) / jnp.maximum(dt, 1e-3)
    by_angle = jnp.isfinite(turned) & (jnp.abs(turned) < most) & (dt > 0)
    by_speed = jnp.isfinite(z.wheel_speed) & (jnp.abs(z.wheel_speed) < most)
    read = jnp.where(by_angle, turned, jnp.where(by_speed, z.wheel_speed, old.speed))
    known = jnp.isfinite(z.wheel_angle) & (jnp.abs(z.wheel_angle) < 1e7)
    first = known & ~jnp.isfinite(old.angle) & ~by_speed  # nothing to compare with: it stands
    good = by_angle | by_speed | first
    # a clock that stands, or says nothing, tells nothing of wheels either
    age = jnp.where(good & (dt > 0), 0.0, jnp.minimum(old.age + jnp.maximum(dt, UNTIMED_S), 1e3))
    speed = jnp.where(age > settings.stale_s, 0.0, read)
    heard = known & ((dt > 0) | ~jnp.isfinite(old.angle))
    angle = jnp.where(heard, z.wheel_angle, old.angle + speed * dt)
    return speed, angle, age


class Estimator(eqx.Module):
    """Filter over the floors under the wheels, with pose and covariance.

    Attributes:
        frozen: the identified robot.
        settings: what is not identified.
    """

    frozen: Frozen
    settings: Settings = eqx.field(static=True, default=Settings())

    @property
    def hypotheses(self) -> np.ndarray:
        """Floor under every wheel in every hypothesis (hypothesis, wheel)."""
        floors, wheels = len(self.frozen.labels), self.frozen.wheels
        return np.array(list(itertools.product(range(floors), repeat=wheels)))

    @property
    def sensed(self) -> Layout:
        """Layout of a measurement."""
        return sensed(self.frozen.wheels)

    @property
    def estimated(self) -> Layout:
        """Layout of an estimate."""
        return estimated(self.frozen.wheels, len(self.frozen.labels))

    @property
    def _kept(self) -> Layout:
        w, k = self.frozen.wheels, len(self.frozen.labels)
        c, n = k**w, 3 + 3 * k + 1
        return Layout(
            (
                ("time", ()),
                ("angle", (w,)),
                ("speed", (w,)),
                ("age", (w,)),
                ("amps", (w,)),
                ("belief", (c + 1,)),
                ("twist", (c, 3)),
                ("apart", (c, 3)),
                ("pose", (3,)),
                ("more", (n - 3,)),
                ("covariance", (n, n)),
                ("still", ()),
                ("stuck", ()),
                ("noise", (3, 3)),
                ("history", (HISTORY, 14)),
            )
        )

    def init(
        self, pose: Any = (0.0, 0.0, 0.0), std: tuple[float, float] = (0.0, 0.0)
    ) -> Float[Array, " state"]:
        """State of a robot at rest.

        Args:
            pose: where it stands [m, m, rad].
            std: how well that is known [m], [rad].
        """
        s, k = self.settings, len(self.frozen.labels)
        prior = self._prior()
        start = jnp.asarray(pose, dtype=float)
        place, turn = std
        variance = [place**2, place**2, turn**2]
        diagonal = jnp.concatenate(
            [
                jnp.asarray(variance),
                self.frozen.effect.reshape(-1) ** 2,
                jnp.asarray([s.gyro_bias_std**2]),
            ]
        )
        w = self.frozen.wheels
        log = jnp.concatenate([jnp.zeros(1), start, jnp.zeros(10)])
        return self._kept.pack(
            time=0.0,
            angle=jnp.full(w, jnp.nan),
            speed=jnp.zeros(w),
            age=jnp.full(w, 10 * s.stale_s),
            amps=jnp.zeros(w),
            belief=jnp.concatenate([prior * 0.99, jnp.asarray([0.01])]),
            twist=jnp.zeros((k**w, 3)),
            apart=jnp.zeros((k**w, 3)),
            pose=start,
            more=jnp.zeros(3 * k + 1),
            covariance=jnp.diag(diagonal),
            still=0.0,
            stuck=0.0,
            noise=jnp.zeros((3, 3)),
            history=jnp.broadcast_to(log, (HISTORY, 14)),
        )

    def step(
        self,
        state: Float[Array, " state"],
        measurement: Float[Array, " sensed"],
        dt: Float[Array, ""] | float,
    ) -> tuple[Float[Array, " state"], Float[Array, " estimated"]]:
        """One time step.

        Args:
            state: from `init` or the last step.
            measurement: as `sensed` lays it out; NaN, infinities and what no sensor of this robot
                could read count as not measured.
            dt: since the last step [s]; where it is no positive number, no time has passed.
        """
        f, s, old = self.frozen, self.settings, self._kept.of(state)
        z = self.sensed.of(measurement)
        dt = jnp.asarray(dt, dtype=float)
        passed = jnp.isfinite(dt) & (dt > 0)
        dt = jnp.where(passed, jnp.clip(dt, 1e-4, s.longest_s), 0.0)
        w, angle, age = read_wheels(f, s, old, z, dt)
        amps, heard, noise = self._currents(old, z, w, dt)
        faster = jnp.max(jnp.abs(w - old.speed)) / jnp.maximum(dt, 1e-3)
        xi, predicted = self._solve(old.twist, w)
        gyro = jnp.where(jnp.isfinite(z.gyro) & (jnp.abs(z.gyro) < 50.0), z.gyro, jnp.nan)
        rim = jnp.max(jnp.abs(f.frame.radius * w))
        moves = rim > s.still_m_s
        turn = gyro - old.more[-1]
        noise += self._stiction(w)
        belief, apart = self._filter(
            old, xi, predicted, amps, heard, noise, turn, dt, faster, moves
        )
        return self._finish(old, z, dt, w, angle, age, amps, xi, belief, apart, gyro, moves)

    def _prior(self) -> Float[Array, " hypothesis"]:
        """Probability of every hypothesis before anything is measured."""
        kinds = np.array([len(set(row)) for row in self.hypotheses.tolist()])
        weight = np.exp(-self.settings.alike * (kinds - 1))
        return jnp.asarray(weight / weight.sum())

    def _currents(self, old: Any, z: Any, w: Any, dt: Any) -> tuple[Array, Array, Array]:
        """Filtered currents, which wheels have one, and the variance of their sensors [A^2]."""
        s, motor, most = self.settings, self.frozen.motor, 10.0 * self.frozen.highest[1]
        known = jnp.isfinite(z.current) & (jnp.abs(z.current) < most)
        volts = jnp.isfinite(z.voltage) & (jnp.abs(z.voltage) < 1e3)
        by_volts = (z.voltage - motor.voltage(jnp.zeros_like(w), w)) / motor.resistance
        volts &= jnp.abs(by_volts) < most
        var_i, var_u = s.ammeter_std_a**2, (s.voltmeter_std_v / motor.resistance) ** 2
        zero = z.current - motor.current_offset
        sign = jnp.where(by_volts < 0, -1.0, 1.0)
        ammeter = (
            zero if s.current_is_signed else jnp.where(volts, sign * jnp.abs(zero), jnp.abs(zero))
        )
        share = jnp.where(known & volts, var_u / (var_i + var_u), jnp.where(volts, 0.0, 1.0))
        now = share * jnp.where(known, ammeter, 0.0) + (1 - share) * jnp.where(volts, by_volts, 0.0)
        heard = known | volts
        a = 1 - jnp.exp(-dt / s.filter_s)
        amps = jnp.where(heard, old.amps + a * (now - old.amps), old.amps)
        noise = share**2 * var_i + (1 - share) ** 2 * var_u
        # with a voltage the sign is known; without, and unsigned, only the size
        return amps, jnp.where(heard, jnp.where(volts | s.current_is_signed, 2, 1), 0), noise

    def _stiction(self, w: Array) -> Array:
        """Variance of the current that holds a standing wheel, between friction's bounds [A^2]."""
        motor = self.frozen.motor
        gain = motor.gear_ratio * motor.efficiency * motor.back_emf
        return (1 - jnp.tanh(w / 0.2) ** 2) * (motor.coulomb_friction / gain) ** 2 / 3

    def _solve(self, near: Array, w: Array) -> tuple[Array, Array]:
        """Twist and currents of every hypothesis, from the last step's twists."""
        f = self.frozen
        floors = combine(f.frame, f.floors, self.hypotheses, f.rest, f.inverse)
        rim = f.frame.radius * w
        twist, pull = settle(near.T, rim, floors)
        torque = floors.friction * f.mass * GRAVITY * f.frame.radius * pull
        amps = f.motor.current(torque.T, jnp.broadcast_to(w, torque.T.shape))
        more = f.current_trend @ jnp.stack([1.0, _size((f.inverse @ rim)[:2])])
        return twist.T, amps + jnp.sign(amps) * more

    def _filter(
        self,
        old: Any,
        xi: Array,
        predicted: Array,
        amps: Array,
        heard: Array,
        noise: Array,
        turn: Array,
        dt: Array,
        faster: Array,
        moves: Array,
    ) -> tuple[Array, Array]:
        """Probability of every hypothesis and of none, and how far each one's way is from the mean.

        A hypothesis keeps the way it would have gone: when currents later speak for it, the pose is
        corrected by what was not believed in time (interacting multiple models; Blom and
        Bar-Shalom 1988).
        """
        f, s = self.frozen, self.settings
        std = f.current_std[jnp.asarray(self.hypotheses)]
        size = jnp.sqrt(predicted**2 + 0.03**2)
        gap = jnp.where(heard == 2, predicted - amps, size - jnp.abs(amps))
        var = std**2 + noise
        worst = (s.unknown_std + 1.0) ** 2
        score = jnp.minimum(gap**2 / var, worst)
        told = jnp.sum(jnp.where(heard > 0, -0.5 * (score + jnp.log(var)), 0.0), axis=1)
        none = jnp.sum(
            jnp.where(heard > 0, -0.5 * (s.unknown_std**2 + jnp.log(jnp.mean(var, axis=0))), 0.0)
        )
        yaw = jnp.mean(f.effect[:, 2]) * jnp.maximum(_size(xi[:, :2]), 0.02)
        gyro_var = s.gyro_std**2 + yaw**2
        off = jnp.minimum((xi[:, 2] - turn) ** 2 / gyro_var, worst)
        has = jnp.isfinite(turn)
        told += jnp.where(has, -0.5 * (off + jnp.log(gyro_var)), 0.0)
        none += jnp.where(has, -0.5 * (s.unknown_std**2 + jnp.log(jnp.mean(gyro_var))), 0.0)
        # what the equilibrium does not know, inertia, weighs little while wheels speed up
        weight = jnp.where(moves, dt / s.forget_s, 0.0) / (1 + (faster / HASTE) ** 2)
        known, unknown = old.belief[:-1], old.belief[-1]
        mean = known @ xi / jnp.maximum(jnp.sum(known), 1e-12)
        change = 1 - jnp.exp(-_size(mean[:2]) * dt / s.patch_m)
        way = old.apart + jnp.where(moves, dt, 0.0) * (xi - mean)
        whole = jnp.concatenate([known[:, None], known[:, None] * way], axis=1)
        whole = jax.vmap(self._change, (1, None), 1)(whole, change)
        moved = whole[:, 0]
        way = whole[:, 1:] / jnp.maximum(moved, 1e-9)[:, None]
        prior = jnp.concatenate(
            [
                moved * (1 - 0.05 * change) + 0.2 * change * unknown * self._prior(),
                (unknown * (1 - 0.2 * change) + 0.05 * change * jnp.sum(known))[None],
            ]
        )
        log = jnp.log(jnp.maximum(prior, 1e-12)) + weight * jnp.append(told, none)
        return jax.nn.softmax(log), way

    def _change(self, p: Array, change: Array) -> Array:
        """Every wheel may come to another floor, as likely as the prior says given the others."""
        wheels, floors = self.frozen.wheels, len(self.frozen.labels)
        prior = self._prior().reshape((floors,) * wheels)
        p = p.reshape((floors,) * wheels)
        for axis in range(wheels):
            given = prior / jnp.sum(prior, axis=axis, keepdims=True)
            p = (1 - change) * p + change * jnp.sum(p, axis=axis, keepdims=True) * given
        return p.reshape(-1)

    def _finish(
        self,
        old: Any,
        z: Any,
        dt: Array,
        w: Array,
        angle: Array,
        age: Array,
        amps: Array,
        xi: Array,
        belief: Array,
        apart: Array,
        gyro: Array,
        moves: Array,
    ) -> tuple[Array, Array]:
        """Pose, covariance and what is said of them."""
        f, s = self.frozen, self.settings
        known = belief[:-1] / jnp.maximum(jnp.sum(belief[:-1]), 1e-12)
        mean = known @ xi
        scatter = (xi - mean).T @ (known[:, None] * (xi - mean))
        under = self._marginal(known)  # (wheel, floor)
        share = f.rest @ under
        speed = _size(mean[:2]) + f.frame.base * jnp.abs(mean[2])
        u = jnp.where(speed > 1e-6, mean[:2] / jnp.maximum(_size(mean[:2]), 1e-9), 0.0)
        axes = jnp.array([[u[0], -u[1], 0.0], [u[1], u[0], 0.0], [0.0, 0.0, 1.0]])
        # d twist / d effects, a column per floor and axis
        slope = speed * (share[:, None, None] * axes.T).reshape(-1, 3).T
        free = jnp.where(moves, mean + slope @ old.more[:-1], 0.0)
        has = jnp.isfinite(gyro)
        time = old.time + dt
        twist = free.at[2].set(self._turned(old, time, free[2], gyro))
        late_news = known @ apart
        apart = apart - late_news
        late_news = late_news.at[2].multiply(jnp.where(has, 0.0, 1.0))
        pose = compose(old.pose, advance(twist, dt) + late_news)
        cov, noise = self._grow(old, pose, dt, speed, slope, axes, share, scatter, has, moves)
        noise = old.noise + noise
        still = jnp.where(moves, 0.0, jnp.minimum(old.still + dt, 1e3))
        pose, more, cov = self._rest(still, gyro, pose, old.more, cov)
        entry = jnp.concatenate([time[None], pose, free[2:], noise.reshape(-1)])
        history = jnp.where(dt > 0, jnp.roll(old.history, 1, axis=0).at[0].set(entry), old.history)
        pose, more, cov, history = self._fix(z, time, pose, more, cov, noise, history)
        stuck = self._stuck(old, w, twist, dt, moves)
        state = self._kept.pack(
            time=time,
            angle=angle,
            speed=w,
            age=age,
            amps=amps,
            belief=belief,
            twist=xi,
            apart=apart,
            pose=pose,
            more=more,
            covariance=cov,
            still=still,
            stuck=stuck,
            noise=noise,
            history=history,
        )
        said = self.estimated.pack(
            pose=pose,
            twist=twist,
            slip=self._slip(w, twist),
            wheel_speed=w,
            current=amps,
            surface=jnp.concatenate(
                [under * (1 - belief[-1]), jnp.full((f.wheels, 1), belief[-1])], axis=1
            ),
            covariance=cov[:3, :3],
            stale=jnp.any(age > s.stale_s),
            immobilised=stuck > 0.4,
            out_of_range=self._beyond(w, amps, belief),
        )
        return state, said

    def _turned(self, old: Any, time: Array, free: Array, gyro: Array) -> Array:
        """Yaw rate: the gyro's less its bias; over its delay, as the contact model goes on from it.

        Args:
            old: state before the step; time: after it [s].
            free: yaw rate of the contact model [rad/s].
            gyro: reading, NaN where there is none [rad/s].
        """
        delay = self.settings.gyro_delay_s
        then = free if delay == 0.0 else _nearest(old.history, time - delay)[4]
        return jnp.where(jnp.isfinite(gyro), free + gyro - old.more[-1] - then, free)

    def _rest(
        self, still: Array, gyro: Array, pose: Array, more: Array, cov: Array
    ) -> tuple[Array, Array, Array]:
        """Learn the gyro's bias while the robot rests.

        A reading that differs from what is known is a robot that creeps on an edge or is turned by
        hand, no bias.
        """
        gap = gyro - more[-1]
        var = cov[-1, -1] + self.settings.gyro_std**2
        rests = jnp.isfinite(gyro) & (still > 0.3) & (gap**2 < 9.0 * var)
        gain = jnp.where(rests, cov[:, -1] / var, 0.0)
        change = gain * jnp.where(rests, gap, 0.0)
        return pose + change[:3], more + change[3:], cov - jnp.outer(gain, cov[-1])

    def _slip(self, w: Array, twist: Array) -> Array:
        """Slip ratio of each wheel, 0 for one that stands."""
        f, turns = self.frozen, jnp.abs(w) > 1e-3
        rim = f.frame.radius * jnp.where(turns, w, 1.0)
        return jnp.where(turns, jnp.clip(1 - f.forward @ twist / rim, -2.0, 2.0), 0.0)

    def _stuck(self, old: Any, w: Array, twist: Array, dt: Array, moves: Array) -> Array:
        """For how long the body has hardly moved while its wheels turn [s].

        Source: Ward and Iagnemma 2008, below a fifth of the wheels' speed.
        """
        f = self.frozen
        speed = _size((f.inverse @ (f.frame.radius * w))[:2])
        blocked = moves & (speed > 0.02) & (_size(twist[:2]) < 0.2 * speed)
        return jnp.where(blocked, jnp.minimum(old.stuck + dt, 1e3), 0.0)

    def _beyond(self, w: Array, amps: Array, belief: Array) -> Array:
        """Whether speed or currents leave what the fit has seen, or no floor explains them."""
        highest = self.frozen.highest
        fast = jnp.max(jnp.abs(w)) > 1.3 * highest[0]
        return fast | (jnp.max(jnp.abs(amps)) > 1.3 * highest[1]) | (belief[-1] > 0.5)

    def _marginal(self, known: Array) -> Array:
        """Probability of each floor under each wheel (wheel, floor)."""
        wheels, floors = self.frozen.wheels, len(self.frozen.labels)
        p = known.reshape((floors,) * wheels)
        others = [tuple(k for k in range(wheels) if k != axis) for axis in range(wheels)]
        return jnp.stack([jnp.sum(p, axis=o) for o in others])

    def _grow(
        self,
        old: Any,
        pose: Array,
        dt: Array,
        speed: Array,
        slope: Array,
        axes: Array,
        share: Array,
        scatter: Array,
        has: Array,
        moves: Array,
    ) -> tuple[Array, Array]:
        """Covariance of pose, effects and gyro bias after the step; noise that came in with it."""
        f, s = self.frozen, self.settings
        middle = old.pose[2] + 0.5 * (pose[2] - old.pose[2])
        c, sn = jnp.cos(middle), jnp.sin(middle)
        world = jnp.array([[c, -sn, 0.0], [sn, c, 0.0], [0.0, 0.0, 1.0]])
        gone = pose[:2] - old.pose[:2]
        on = jnp.where(moves, dt, 0.0)
        by_gyro = jnp.array([1.0, 1.0, 0.0])
        keep = jnp.where(has, by_gyro, jnp.ones(3))  # yaw comes from the gyro, not from the floor
        push = world @ (keep[:, None] * slope) * on
        drift = jnp.array([[0.0], [0.0], [1.0]]) * jnp.where(has, -dt, 0.0)
        turned = jnp.array([[1.0, 0.0, -gone[1]], [0.0, 1.0, gone[0]], [0.0, 0.0, 1.0]])
        by = jnp.concatenate([turned, push, drift], axis=1)  # d pose / d (pose, effects, bias)
        far = speed * on
        grown = (share @ f.process**2) * far
        floor_axes = world @ (keep[:, None] * axes)
        # which floor it is stays in doubt for about a patch
        doubt = scatter * keep[:, None] * keep[None, :] * on * s.patch_m / jnp.maximum(speed, 0.02)
        noise = (floor_axes * grown) @ floor_axes.T + world @ doubt @ world.T
        noise = noise.at[2, 2].add(jnp.where(has, (s.gyro_std * dt) ** 2, 0.0))
        rows = by @ old.covariance  # what is not the pose stays as it is
        pose_rows = jnp.concatenate([rows @ by.T + noise, rows[:, 3:]], axis=1)
        rest = jnp.concatenate([rows[:, 3:].T, old.covariance[3:, 3:]], axis=1)
        return jnp.concatenate([pose_rows, rest]), noise

    def _fix(
        self,
        z: Any,
        time: Array,
        pose: Array,
        more: Array,
        cov: Array,
        noise: Array,
        history: Array,
    ) -> tuple[Array, Array, Array, Array]:
        """Correct by a pose fix of some time ago, if there is one."""
        age = jnp.where(jnp.isfinite(z.fix_age) & (z.fix_age >= 0), z.fix_age, 0.0)
        std = z.fix_std
        has = (
            jnp.all(jnp.isfinite(z.fix))
            & jnp.all(jnp.abs(z.fix[:2]) < 1e4)
            & jnp.all(jnp.isfinite(std))
            & jnp.all(std > 0)
            & (age < time - history[-1, 0] + 1e-6)
        )

        def corrected() -> tuple[Array, Array, Array, Array]:
            then = _nearest(history, time - age)
            since = noise - then[5:].reshape(3, 3)
            return _correct(z.fix, jnp.clip(std, 1e-4, 10.0), then, since, pose, more, cov, history)

        kept = (pose, more, cov, history)
        found: tuple[Array, Array, Array, Array] = jax.lax.cond(has, corrected, lambda: kept)
        return found


def _correct(
    fix: Array,
    std: Array,
    then: Array,
    since: Array,
    pose: Array,
    more: Array,
    cov: Array,
    history: Array,
) -> tuple[Array, Array, Array, Array]:
    """Pose, further unknowns, covariance and history after a fix of the pose of `then`.

    What came in `since`, a covariance of the pose, the fix has not seen: it is set aside. What the
    pose no longer holds of it, a later fix having seen it, is so much noise of this one.
    """
    held = _within(since, cov[:3, :3])
    aside = jnp.zeros_like(cov).at[:3, :3].set(held)
    cov = cov - aside
    gap = fix - then[1:4]
    gap = gap.at[2].set(jnp.arctan2(jnp.sin(gap[2]), jnp.cos(gap[2])))
    gone = pose[:2] - then[1:3]
    look = jnp.zeros((3, cov.shape[0])).at[:, :3].set(jnp.eye(3))
    look = look.at[0, 2].set(gone[1]).at[1, 2].set(-gone[0])
    noise = jnp.diag(jnp.stack([std[0], std[0], std[1]]) ** 2) + since - held
    total = look @ cov @ look.T + noise
    # a fix far from what is believed counts less, yet counts
    far = gap @ _inverse(total) @ gap
    total = total + noise * jnp.maximum(far / 9.0 - 1.0, 0.0)
    gain = cov @ look.T @ _inverse(total)
    change = gain @ gap
    cov = cov - gain @ look @ cov
    cov = 0.5 * (cov + cov.T) + aside
    back = history[:, 1:3] - pose[:2]
    moved = change[:2] + change[2] * jnp.stack([-back[:, 1], back[:, 0]], axis=-1)
    history = history.at[:, 1:3].add(moved).at[:, 3].add(change[2])
    return pose + change[:3], more + change[3:], cov, history


def _within(part: Float[Array, "3 3"], whole: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """As much of a covariance as another one can hold.

    The largest eigenvalue of their quotient is at most the eighth root of the trace of its eighth
    power, and at least 1 / 1.15 of that.
    """
    m = _inverse(whole) @ part
    for _ in range(3):
        m = m @ m
    most = jnp.maximum(jnp.trace(m), 1e-12) ** 0.125
    return jnp.where(jnp.isfinite(most), part / jnp.maximum(most, 1.0), 0.0)


def _nearest(history: Array, time: Array) -> Array:
    """Entry nearest to a time: time, pose, yaw rate of the contact model, noise until then."""
    return history[jnp.argmin(jnp.abs(history[:, 0] - time))]


def _size(v: Float[Array, "*batch axis"]) -> Float[Array, "*batch"]:
    """Length of a vector, with a derivative at zero."""
    return jnp.sqrt(jnp.sum(v * v, axis=-1) + 1e-24)


def _inverse(m: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Inverse of a positive definite matrix by the adjugate."""
    rows = jnp.stack([jnp.cross(m[1], m[2]), jnp.cross(m[2], m[0]), jnp.cross(m[0], m[1])], axis=1)
    return rows / jnp.maximum(m[0] @ rows[:, 0], 1e-30)
