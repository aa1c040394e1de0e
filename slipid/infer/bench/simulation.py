"""Open-loop simulation of a motor from its voltage.

The states are the current i and the shaft speed w:

    L_a di/dt = u - U_0 - R (1 + h t) i - C_e w - D(i)
    J dw/dt   = C_e i - b w - F(w)

with the voltage D of the contacts and the dry friction F of `BenchMotor`. The voltage u is held, or
straight, between rows, and it arrives `voltage_delay` after its row. The linear part is integrated
exactly (exponential of a 2 x 2 matrix), however short its time constants are. Within a row, D and F
have constant means along a simplified path: the shaft stops in the middle of a row if its friction
stops it then, and the current follows a jump of the voltage along a ramp. Errors are about
of second order in the time between rows.

Records are cut into segments, which are simulated side by side from given states.
"""

from dataclasses import fields
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.infer.bench.motor import BenchMotor
from slipid.parameter import Numbers
from slipid.support.jax_setup import unfused

CONTEXT = 3
"""Number of rows beyond both ends of a segment that a delay of the voltage may reach."""
LEAST_TIME_CONSTANT_S = 1e-6
"""Smallest electrical time constant L_a / R in a simulation [s]."""
NEWTON_STEPS = 3
"""Number of Newton steps for the current through the contacts."""
CHUNK = 1024
"""Number of rows whose derivatives are computed at once by one compiled program."""

NAMES = tuple(f.name for f in fields(BenchMotor))
"""Names of the parameters of a motor, in the order of a simulation's vector."""

State = tuple[Array, Array]
"""Currents [A] and shaft speeds [rad/s] of segments."""
States = Float[np.ndarray, "segment step 2"]


class Inputs(NamedTuple):
    """Inputs of a simulation; row k of a segment is the end of its step k.

    Attributes:
        step: duration of each step, 0 for steps that only fill a segment [s].
        time: time of each step since the middle of the records [s].
        voltage: voltage of each row, from `CONTEXT` rows before the first step's start to `CONTEXT`
            rows after the last step's end [V].
        straight: 1 where the voltage is straight from a row to its next, 0 where it jumps between.
        shifted: 1 if a delay shifts a straight voltage, 0 if it is that of the jumps between rows.
        driven: 1 for a voltage; 0 if `voltage` holds the current of a motor without a voltmeter.
        period: median time between rows [s].
    """

    step: Float[np.ndarray, "segment step"]
    time: Float[np.ndarray, "segment step"]
    voltage: Float[np.ndarray, "segment padded"]
    straight: Float[np.ndarray, "segment padded"]
    shifted: float
    driven: float
    period: float


class StepInputs(NamedTuple):
    """Inputs of steps: voltages before and after the first change in the step, and at the next one.

    Attributes:
        step, time: as those of `Inputs`.
        before, now, next: voltages [V].
        straight: 1 where the voltage is straight from `before` to `now`.
        whole: whole rows in the delay of the voltage.
        shifted, driven, period: as those of `Inputs`.
    """

    step: Float[Numbers, "*steps"]
    time: Float[Numbers, "*steps"]
    before: Float[Numbers, "*steps"]
    now: Float[Numbers, "*steps"]
    next: Float[Numbers, "*steps"]
    straight: Float[Numbers, "*steps"]
    whole: Float[Numbers, ""]
    shifted: Float[Numbers, ""]
    driven: Float[Numbers, ""]
    period: Float[Numbers, ""]


class _Steps(NamedTuple):
    """Coefficients of steps: the end of a step is linear in its start, and in D and F.

    Attributes:
        i_i, i_w, w_i, w_w: derivatives of current and speed at the end by those at the start.
        i_0, w_0: current and speed at the end, from the voltage alone.
        i_e, w_e: responses to a constant voltage of 1 V during the step.
        i_t, w_t: responses to a constant torque of 1 N m against the direction of rotation.
        i_fast: response of the current to a voltage of 1 V at constant speed.
        share: part of the step before the voltage jumps.
        ramp: two electrical time constants over the duration of the rest of the step.
        lag: mean delay with which D acts on the current at the end, over the same duration, where
            both change at constant rates.
        kept: change of the current that this does not include, over that of its transition.
        early: part of the effect of D on the current at the end that is from before the jump.
        jumps: 1 if it jumps.
        drop: 1, or 0 if the current is given, so that contacts have no effect.
        resistance: winding resistance [ohm].
    """

    i_i: Array
    i_w: Array
    w_i: Array
    w_w: Array
    i_0: Array
    w_0: Array
    i_e: Array
    w_e: Array
    i_t: Array
    w_t: Array
    i_fast: Array
    share: Array
    ramp: Array
    lag: Array
    kept: Array
    early: Array
    jumps: Array
    drop: Array
    resistance: Array


def simulated(
    values: Float[np.ndarray, " parameter"], start: Float[np.ndarray, "segment 2"], inputs: Inputs
) -> States:
    """Return the states at the end of each step.

    Args:
        values: parameters in the order in which `BenchMotor` declares them [SI].
        start: current [A] and shaft speed [rad/s] at the start of each segment.
        inputs: inputs of the segments.
    """
    return np.asarray(_states(values, start, _step_inputs(values, inputs)))


def derivatives(
    values: Float[np.ndarray, " parameter"],
    start: Float[np.ndarray, "segment 2"],
    states: States,
    inputs: Inputs,
) -> Float[np.ndarray, "segment step 2 derivative"]:
    """Return the derivatives of simulated states by the parameters, then by both start states.

    `states` are those that `simulated` returns. Each step's derivatives by its start and by the
    parameters are computed side by side, and chained from step to step.
    """
    at = _step_inputs(values, inputs)
    before = np.concatenate([start[:, None], states[:, :-1]], axis=1)
    columns = [np.asarray(x).ravel() for x in (before[..., 0], before[..., 1], *at[:6])]
    missing = -columns[0].size % CHUNK
    chunks = np.stack([np.pad(x, (0, missing), mode="edge") for x in columns]).reshape(8, -1, CHUNK)
    parts = [np.asarray(_of_steps(values, chunks[:, k], at[6:])) for k in range(chunks.shape[1])]
    count = len(values)
    each = np.concatenate(parts, axis=-1)[..., : columns[0].size]
    each = np.moveaxis(each, -1, 0).reshape(*states.shape, count + 2)
    out = np.empty_like(each)
    now = np.zeros((len(start), 2, count + 2))
    now[:, [0, 1], [count, count + 1]] = 1.0
    for k in range(states.shape[1]):
        now = each[:, k, :, count:] @ now
        now[..., :count] += each[:, k, :, :count]
        out[:, k] = now
    return out


@jax.jit
def _states(
    values: Float[Array, " parameter"], start: Float[Array, "segment 2"], inputs: StepInputs
) -> Float[Array, "segment step 2"]:
    m = BenchMotor(*values)

    def one(state: State, at: _Steps) -> tuple[State, State]:
        new = _stepped(m, state, at)
        return new, new

    steps = jax.tree.map(jnp.transpose, _steps(m, inputs))
    _, states = jax.lax.scan(one, (start[:, 0], start[:, 1]), steps)
    return jnp.stack(states, axis=-1).swapaxes(0, 1)


@partial(jax.jit, compiler_options=unfused())
def _of_steps(
    values: Float[Array, " parameter"],
    columns: Float[Array, "column row"],
    common: tuple[Float[Array, ""], ...],
) -> Float[Array, "2 derivative row"]:
    """Return the derivatives of both states after steps by parameters and by the states before.

    `columns` are current and speed before each step and the first fields of `StepInputs`, of which
    `common` are the others.
    """
    current, speed, *own = columns

    def after(each: list[Array], i: Array, w: Array) -> State:
        m = BenchMotor(*each)
        return _stepped(m, (i, w), _steps(m, StepInputs(*own, *common)))

    # Every row has its own copy of the parameters, so that one sweep gives all derivatives.
    each = [jnp.broadcast_to(x, current.shape) for x in values]
    (one, _), pull = jax.vjp(after, each, current, speed)
    rows = []
    for seed in (
        (jnp.ones_like(one), jnp.zeros_like(one)),
        (jnp.zeros_like(one), jnp.ones_like(one)),
    ):
        by_each, by_current, by_speed = pull(seed)
        rows.append(jnp.stack([*by_each, by_current, by_speed]))
    return jnp.stack(rows)


def _step_inputs(values: Float[np.ndarray, " parameter"], inputs: Inputs) -> StepInputs:
    """Return the voltages of every step after the delay of a motor."""
    late = values[NAMES.index("voltage_delay")] / inputs.period
    # A delay of whole rows is one, however it was rounded.
    whole = int(np.clip(np.floor(late + 1e-9), -CONTEXT, CONTEXT - 1))
    first, count = CONTEXT + 1 - whole, inputs.step.shape[1]

    def rows(x: np.ndarray, offset: int) -> np.ndarray:
        padded = np.pad(x, ((0, 0), (1, 1)), mode="edge")
        return padded[:, first + offset : first + offset + count]

    return StepInputs(
        step=inputs.step,
        time=inputs.time,
        before=rows(inputs.voltage, -1),
        now=rows(inputs.voltage, 0),
        next=rows(inputs.voltage, 1),
        straight=rows(inputs.straight, -1),
        whole=np.asarray(float(whole)),
        shifted=np.asarray(inputs.shifted),
        driven=np.asarray(inputs.driven),
        period=np.asarray(inputs.period),
    )


def _stepped(m: BenchMotor, state: State, at: _Steps) -> State:
    """Return the state after a step.

    The torque depends on the mean of D over the step, and the current on D at its end and shortly
    before.
    """
    i, w = state
    i_free = at.i_0 + at.i_i * i + at.i_w * w
    w_free = at.w_0 + at.w_i * i + at.w_w * w
    before = at.drop * jnp.sign(i) * m.contact_voltage(jnp.abs(i), at.resistance)[0]
    resting = m.dry_friction(jnp.zeros_like(w))
    dry = _Dry(m.dry_friction(w), resting, resting)
    torque = _friction(dry, w, w_free - at.w_e * before, at)
    slow = at.i_e - at.i_fast
    end, slope = _through_contacts(m, i_free + at.i_t * torque - slow * before, at)
    softer = 1 + at.drop * at.i_fast * slope
    # The current right after a jump of the voltage is that of the end at the speed of the jump.
    moved = w_free - at.w_e * before + at.w_t * torque - w
    after = end + (1 - at.share) * m.back_emf / at.resistance * moved / softer
    begun = jnp.where(at.jumps > 0, after, i)
    mean = at.share * before + (1 - at.share) * at.drop * _mean_contacts(
        m, (i, begun, end), at.ramp / (1 + at.drop * slope / at.resistance), at
    )
    w_free = w_free - at.w_e * mean
    last = w_free + at.w_t * torque
    dry = _Dry(m.dry_friction((w + last) / 2), resting, m.dry_friction(last / 2))
    new = _friction(dry, w, w_free, at)
    late = at.lag * (end - begun) - at.kept * (i - begun)
    late = (1 - at.early) * late + at.early * (end - i)
    change = at.i_t * (new - torque) - slow * (mean - before) + at.drop * at.i_fast * slope * late
    return end + change / softer, w_free + at.w_t * new


def _mean_contacts(
    m: BenchMotor, path: tuple[Array, Array, Array], ramp: Array, at: _Steps
) -> Array:
    """Return the mean voltage of the contacts after a jump of the voltage.

    `path` is the current before the jump, after it, and at the end. A ramp of two time constants
    covers the same area as the exponential transition from the first to the second one.
    """
    i, begun, end = path
    ramp = jnp.minimum(ramp, 1.0)
    knee = begun + ramp * (end - begun)
    transition = m.mean_contact_voltage(i, knee, at.resistance)
    return ramp * transition + (1 - ramp) * m.mean_contact_voltage(knee, end, at.resistance)


class _Dry(NamedTuple):
    """Dry friction of a shaft that turns, that rests, and that turns again after it has stopped."""

    turning: Array
    resting: Array
    again: Array


def _friction(dry: _Dry, w: Array, w_free: Array, at: _Steps) -> Array:
    """Return the mean dry friction in a step from speed w, which ends at `w_free` without it.

    If the shaft stops within the step, it rests for the remainder, or turns again if more than the
    friction at rest drives it. The acceleration counts as constant.
    """
    moving = jnp.sign(w) * dry.turning
    end = w_free + at.w_t * moving
    until = jnp.where(w * end <= 0, w / jnp.where(w == end, 1.0, w - end), 1.0)
    needed = (w - w_free) / at.w_t
    rests = jnp.abs(needed) <= dry.resting
    return until * moving + (1 - until) * jnp.where(rests, needed, jnp.sign(needed) * dry.again)


def _through_contacts(m: BenchMotor, free: Array, at: _Steps) -> tuple[Array, Array]:
    """Return the current i with i = free - i_fast D(i), by Newton's method, and dD/di."""
    size, gain = jnp.abs(free), at.drop * at.i_fast
    # The slope of a concave drop is largest at rest, and so is a resistance that falls.
    at_rest = jnp.maximum(m.relative_fall(jnp.zeros_like(size)), 0.0)
    steepest = m.brush_drop / m.brush_current + at.resistance * at_rest
    lowest = size / (1 + gain * steepest)
    z = jnp.maximum(size - gain * m.brush_drop, lowest) / (
        1 + gain * at.resistance * m.relative_fall(size)
    )
    slope = jnp.zeros_like(z)
    for _ in range(NEWTON_STEPS):
        voltage, slope = m.contact_voltage(z, at.resistance)
        z = jnp.maximum(z - (z + gain * voltage - size) / (1 + gain * slope), lowest)
    return jnp.sign(free) * z, slope


def _steps(m: BenchMotor, at: StepInputs) -> _Steps:
    """Return the coefficients of steps, of two parts: before and after the voltage changes."""
    share = m.voltage_delay / at.period - at.whole
    before, now = at.before, at.now
    # Voltages at the start and the end of both parts, for a shifted voltage and for one that goes
    # from `before` to `now`, straight or at once.
    middle = before + share * (now - before)
    shifted = (now - middle + before, now, now, now + (1 - share) * (at.next - now))
    jumping = (
        before,
        before + at.straight * (middle - before),
        now + at.straight * (middle - now),
        now,
    )
    first, last, new, end = (
        jnp.where(at.shifted > 0, a, b) for a, b in zip(shifted, jumping, strict=True)
    )
    jumps = jnp.asarray((1 - at.straight) * (1 - at.shifted))
    driven = jnp.asarray(at.driven)
    # A given current is a voltage across 1 ohm, without back-EMF.
    resistance = jnp.where(at.driven > 0, m.resistance * (1 + m.resistance_drift * at.time), 1.0)
    zero = jnp.where(at.driven > 0, m.voltage_offset, m.current_offset)
    p = _part(m, at, resistance, share * at.step, (first - zero, last - zero))
    q = _part(m, at, resistance, (1 - share) * at.step, (new - zero, end - zero))
    i_i, i_w = q.i_i * p.i_i + q.i_w * p.w_i, q.i_i * p.i_w + q.i_w * p.w_w
    w_i, w_w = q.w_i * p.i_i + q.w_w * p.w_i, q.w_i * p.i_w + q.w_w * p.w_w
    c, viscous = m.back_emf, m.viscous_friction
    stiff = resistance * viscous + driven * c**2
    rate = resistance / _inductance(m, at, resistance)
    # Times over the electrical time constant: of the step, and of its part after the jump.
    whole = jnp.maximum(at.step * rate, 1e-3)
    rest = jnp.maximum(1 - share * jumps, 1e-3) * whole
    decayed, gone = jnp.exp(-rest), -jnp.expm1(-rest)
    lag = 1 / rest - decayed / gone
    return _Steps(
        i_i=i_i,
        i_w=i_w,
        w_i=w_i,
        w_w=w_w,
        i_0=q.i_0 + q.i_i * p.i_0 + q.i_w * p.w_0,
        w_0=q.w_0 + q.w_i * p.i_0 + q.w_w * p.w_0,
        i_e=(viscous - i_i * viscous - i_w * c) / stiff,
        w_e=(c - w_i * viscous - w_w * c) / stiff,
        i_t=(driven * (c - i_i * c) + i_w * resistance) / stiff,
        w_t=jnp.minimum((-resistance - w_i * driven * c + w_w * resistance) / stiff, -1e-12),
        i_fast=(1 - jnp.exp(-at.step * resistance / _inductance(m, at, resistance))) / resistance,
        share=share * jumps,
        ramp=2 / rest,
        lag=lag,
        kept=decayed * (rest / gone - 1 + lag),
        early=(decayed - jnp.exp(-whole)) / -jnp.expm1(-whole),
        jumps=jumps,
        drop=driven * jnp.ones_like(resistance),
        resistance=resistance,
    )


def _inductance(m: BenchMotor, at: StepInputs, r: Array) -> Array:
    """Return the inductance, at least one whose time constant is not too short to compute [H]."""
    shortest = LEAST_TIME_CONSTANT_S * r
    return jnp.where(at.driven > 0, jnp.maximum(m.inductance, shortest), shortest)


class _Part(NamedTuple):
    """Coefficients of a part of a step, as those of `_Steps` with the same names."""

    i_i: Array
    i_w: Array
    w_i: Array
    w_w: Array
    i_0: Array
    w_0: Array


def _part(m: BenchMotor, at: StepInputs, r: Array, h: Array, voltage: tuple[Array, Array]) -> _Part:
    """Return the coefficients of a part of duration h [s]; its voltage is straight from a to b."""
    u_start, u_end = voltage
    c, b, j = m.back_emf, m.viscous_friction, m.rotor_inertia
    emf, slow = at.driven * c, _inductance(m, at, r)
    a_ii, a_iw, a_wi, a_ww = -r / slow, -emf / slow, c / j, -b / j
    mean, det = (a_ii + a_ww) / 2, a_ii * a_ww - a_iw * a_wi
    square = mean**2 - det
    damped = square > 0
    root = jnp.sqrt(jnp.where(damped, square, 1.0))
    turn = jnp.sqrt(jnp.where(damped, 1.0, -square))
    fast = mean - root
    e_fast, e_slow = jnp.exp(fast * h), jnp.exp(det / fast * h)
    decay = jnp.exp(jnp.where(damped, 0.0, mean) * h)
    cosine = jnp.where(damped, (e_fast + e_slow) / 2, decay * jnp.cos(turn * h))
    sine = jnp.where(damped, (e_slow - e_fast) / (2 * root), decay * jnp.sin(turn * h) / turn)
    i_i, i_w = cosine + sine * (a_ii - mean), sine * a_iw
    w_i, w_w = sine * a_wi, cosine + sine * (a_ww - mean)
    # Stationary response x_s(u) to a voltage, and x(t) = x_s(u_start) + g t + A^-1 g for a ramp.
    stiff = r * b + emf * c
    slope = (u_end - u_start) / jnp.where(h > 0, h, 1.0)
    g_i, g_w = b * slope / stiff, c * slope / stiff
    x_i = (b * u_start - b * slow * g_i + emf * j * g_w) / stiff
    x_w = (c * u_start - c * slow * g_i - r * j * g_w) / stiff
    return _Part(
        i_i,
        i_w,
        w_i,
        w_w,
        x_i + g_i * h - i_i * x_i - i_w * x_w,
        x_w + g_w * h - w_i * x_i - w_w * x_w,
    )
