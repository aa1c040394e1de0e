"""Steps that the generated code must repeat: what goes in, and what the library makes of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.control.closed_loop import PERIOD, Pilot
from slipid.control.export.c99.code import Code
from slipid.control.export.c99.fields import Struct
from slipid.control.export.c99.text import wrapped
from slipid.control.interface import Readings

STEPS = 48


@dataclass(frozen=True)
class Golden:
    """Steps in a row from rest at 0, 0, 0, a row each.

    Attributes:
        given: leaves of the reading, the reference, and dt; said: leaves of the estimate.
        command: wheel speeds [rad/s].
    """

    given: Float[np.ndarray, "step given"]
    said: Float[np.ndarray, "step said"]
    command: Float[np.ndarray, "step wheel"]


def golden(pilot: Pilot[eqx.Module]) -> Golden:
    """A drive in which every sensor speaks up, and is silent, once."""
    run = jax.jit(lambda *given: _step(pilot, *given))
    begin = pilot.init()
    state, rows = (begin.seen, begin.held), []
    for z, reference, dt in _drive(pilot):
        state, said, command = run(state, z, reference, dt)
        rows.append((_flat((z, reference, dt)), _flat(said), np.asarray(command)))
    given, estimates, commands = zip(*rows, strict=True)
    return Golden(np.array(given), np.array(estimates), np.array(commands))


def _step(
    pilot: Pilot[eqx.Module], state: tuple, z: Readings, reference: jax.Array, dt: jax.Array
) -> tuple:
    seen, said = pilot.estimator.step(state[0], z, dt)
    held, command = pilot.controller.step(state[1], reference, said, dt)
    return (seen, held), said, command


def _drive(pilot: Pilot[eqx.Module]) -> Iterator[tuple[Readings, jax.Array, float]]:
    """Readings, references and time steps: a late and a lost one, and wheels silent for long."""
    robot = pilot.controller.robot
    angle, count = np.zeros(robot.wheels), robot.wheels
    for step in range(STEPS):
        t = step * PERIOD
        twist = np.array([0.15 * np.cos(2 * t), 0.12 * np.sin(3 * t), 0.4 * np.sin(t)])
        speed = np.asarray(robot.forward) @ twist / float(robot.frame.radius)
        angle = angle + speed * PERIOD
        z = Readings.nothing(count)
        if step not in (9, *range(26, 34)):
            z = eqx.tree_at(lambda z: z.wheel_angle, z, jnp.asarray(angle))
        if step % 5:
            amps = 0.4 + 0.1 * np.sin(t + np.arange(count))
            z = eqx.tree_at(lambda z: z.current, z, jnp.asarray(amps))
        if step > 40:
            z = eqx.tree_at(lambda z: z.wheel_angle, z, jnp.full(count, jnp.nan))
            z = eqx.tree_at(lambda z: z.wheel_speed, z, jnp.asarray(speed))
        if step > 17:
            z = eqx.tree_at(lambda z: z.voltage, z, jnp.asarray(0.3 * speed))
        if 6 <= step < 16:
            z = eqx.tree_at(lambda z: z.gyro, z, jnp.asarray(twist[2] + 0.01))
        if step in (12, 20):
            fix = jnp.asarray([0.05, 0.02, 0.05]), jnp.asarray([0.01, 0.02]), jnp.asarray(0.08)
            z = eqx.tree_at(lambda z: (z.fix, z.fix_std, z.fix_age), z, fix)
        reference = jnp.asarray([0.15 * t, 0.05 * t, 0.1 * t, 0.15, 0.05, 0.1])
        yield z, reference, {5: 0.02, 15: 0.13, 37: 0.0}.get(step, PERIOD)


def _flat(tree: object) -> Float[np.ndarray, " flat"]:
    leaves = [np.asarray(leaf, float).reshape(-1) for leaf in jax.tree.leaves(tree)]
    return np.concatenate(leaves)


def golden_header(code: Code) -> str:
    """Text of golden.h: the steps as tables, and how structs are filled and read."""
    kept = golden(code.pilot)
    names = [f.name for f in code.estimate.fields for _ in range(f.size)]
    scale = np.maximum(np.abs(kept.said).max(axis=0), 1e-3)
    rows = [
        f"#define GOLDEN_STEPS {len(kept.given)}",
        f"#define GOLDEN_GIVEN {kept.given.shape[1]}",
        f"#define GOLDEN_SAID {kept.said.shape[1]}",
        "",
        *_table("golden_given[GOLDEN_STEPS][GOLDEN_GIVEN]", kept.given),
        *_table("golden_said[GOLDEN_STEPS][GOLDEN_SAID]", kept.said),
        *_table("golden_command[GOLDEN_STEPS][SLIPID_WHEELS]", kept.command),
        *_table("golden_scale[GOLDEN_SAID]", scale),
        "static const char *const golden_names[GOLDEN_SAID] = {",
        *wrapped((f'"{name}"' for name in names), "  "),
        "};",
        "",
        *_filling(code.reading),
        *_reading_out(code.estimate),
    ]
    return "\n".join(rows) + "\n"


def _table(declared: str, values: np.ndarray) -> list[str]:
    def word(value: float) -> str:
        return "NAN" if np.isnan(value) else repr(float(value))

    if values.ndim == 1:
        lines = wrapped(map(word, values), "  ")
    else:
        lines = [x for row in values for x in ("  {", *wrapped(map(word, row), "    "), "  },")]
    return [f"static const double {declared} = {{", *lines, "};", ""]


def _filling(struct: Struct) -> list[str]:
    lines = [f"static void golden_reading({struct.name} *reading, const double *row) {{"]
    place = 0
    for field in struct.fields:
        for k in range(field.size):
            at = f"[{k}]" if field.shape else ""
            lines.append(f"  reading->{field.name}{at} = (slipid_real)row[{place}];")
            place += 1
    return [*lines, "}", ""]


def _reading_out(struct: Struct) -> list[str]:
    lines = [f"static void golden_said_of(const {struct.name} *estimate, double *out) {{"]
    place = 0
    for field in struct.fields:
        if field.size:
            index = "[k]" if field.shape else ""
            value = f"(double)estimate->{field.name}{index}"
            if field.kind == "bool":
                value = f"estimate->{field.name}{index} ? 1.0 : 0.0"
            lines.append(
                f"  for (int k = 0; k < {field.size}; ++k) out[{place} + k] = {value};"
                if field.shape
                else f"  out[{place}] = {value};"
            )
        place += field.size
    return [*lines, "}", ""]
