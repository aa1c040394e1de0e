"""Judgement of a robot's motors on held-out windows: current from voltage and wheel speed.

The torques of floors are not known well enough to simulate a wheel's speed from its voltage, as on
a bench. So the current of every window is predicted from its mean voltage and wheel speed, by the
motor and by least squares for U = R I + C_e w, with and without an offset. All wheels have the same
motor, so their windows count together. The segments are halved at random; each half is predicted by
models of the other one, the motor by one Gauss-Newton step from the fit to all segments.
"""

import jax
import jax.numpy as jnp
import numpy as np

from slipid.data.windows import UNREAD_VARIANCE
from slipid.fitting.newton import newton_step
from slipid.fitting.problem import FitState, Problem
from slipid.fitting.variances import Blocks
from slipid.infer.bench.least_squares import RIVALS, fitted_winding
from slipid.infer.held_out import Errors, HeldOut
from slipid.model.motor import Motor, sign_of_motion

SEED = 0
"""Seed of the division of segments into halves."""
FEWEST = 30
"""Smallest number of readings in a half.

With fewer, a model that is right often loses by chance."""

_current = jax.jit(Motor.current_at)


def robot_held_out(
    problem: Problem, state: FitState, linear: tuple[Blocks, Blocks]
) -> HeldOut | None:
    """Return the errors of predicted currents [A]; None if too few have a current and a voltage.

    Args:
        problem: likelihood of runs with currents and voltages.
        state: end of its fit.
        linear: residuals and Jacobians at that end, from `Problem.linear`.
    """
    w = problem.windows
    read = (w.current_var < UNREAD_VARIANCE) & (w.voltage_var < UNREAD_VARIANCE)
    speed = w.turn / w.dt[..., None]
    sign = 1.0 if w.current_is_signed else np.asarray(sign_of_motion(speed))
    flow = sign * w.current
    half = np.random.default_rng(SEED).permutation(len(w)) % 2
    at = [jnp.asarray(x) for x in (w.voltage, speed, w.direction)]
    squares: dict[str, list[np.ndarray]] = {name: [] for name in ("fit", *RIVALS)}
    for k in range(2):
        used, judged = (read & (half == side)[:, None, None] for side in (1 - k, k))
        if min(used.sum(), judged.sum()) < FEWEST:
            return None
        keep = problem.full_weight
        keep[: len(w)] = half != k
        step = newton_step(problem, state, linear, keep).step
        motor: Motor = problem.space.tree(state.z + step).motor
        shaft = speed * float(motor.gear_ratio)
        currents = {"fit": np.asarray(_current(motor, *at))}
        for name, with_offset in RIVALS.items():
            rival = fitted_winding(flow[used], shaft[used], w.voltage[used], with_offset)
            currents[name] = rival.current(w.voltage, shaft)
        zero = float(motor.current_offset)
        for name, amps in currents.items():
            shown = amps if w.current_is_signed else np.abs(amps)
            offset = zero if name == "fit" else 0.0
            squares[name].append((shown + offset - w.current)[judged] ** 2)
    errors = {
        name: Errors(None, float(np.sqrt(np.concatenate(parts).mean())))
        for name, parts in squares.items()
    }
    return HeldOut(errors.pop("fit"), errors)
