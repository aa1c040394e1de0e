"""A step of a control loop as StableHLO, for programs that run XLA without slipid.

`step.json` lists the step's input and output arrays in their order, with names, shapes and units.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jaxtyping import Array

from slipid.exports.fields import Field, structs_of
from slipid.exports.golden import Golden, golden, loop_step
from slipid.exports.text import template
from slipid.robot.closed_loop import ControlLoop
from slipid.robot.interface import Readings
from slipid.robot.robot_file import typed
from slipid.support.errors import DataError, refused_as
from slipid.support.files import read_bytes
from slipid.support.parsing import arrays_of, json_of

SCHEMA = "slipid.stablehlo/3"
TOLERANCE = 1e-9
"""Largest allowed difference between a number that the loaded program computes and the reference
step, relative to the number's scale [1]."""
PLATFORMS = ("cpu", "cuda", "tpu")
"""Platforms on which the programs run."""
PROGRAMS = ("step.stablehlo", "step_batch.stablehlo")
ABOUT, GOLDEN = "step.json", "golden.npz"
FILES = (*PROGRAMS, ABOUT, GOLDEN)
AGAIN = "export the robot again"


@dataclass(frozen=True)
class Signature:
    """Input and output arrays of a step in their order, as step.json lists them.

    Attributes:
        state: arrays of the state, which are the first inputs and the first outputs.
        given: further inputs: readings, reference, twist and dt.
        said: further outputs: estimate and command.
    """

    state: tuple[Field, ...]
    given: tuple[Field, ...]
    said: tuple[Field, ...]


@dataclass(frozen=True, eq=False)
class Program:
    """An exported step that was loaded from its folder.

    Attributes:
        signature: names and shapes of the step's arrays.
        start: arrays of the state of a robot at rest at the pose 0, 0, 0.
        step: step of one robot.
        batch: step of many robots, with a leading axis on every array.
    """

    signature: Signature
    start: tuple[Array, ...]
    step: export.Exported
    batch: export.Exported


def stablehlo_files(loop: ControlLoop[eqx.Module]) -> dict[str, bytes]:
    """Return the content of the folder's files, keyed by name.

    The files are the step of one robot, the step of many robots, a description of the arrays,
    reference steps and a README.
    """
    begin = loop.init()
    state = begin.estimator, begin.controller
    nothing, zero = Readings.nothing(loop.controller.robot.drives), jnp.zeros(())
    like = (state, nothing, jnp.zeros(6), jnp.zeros(3), zero)
    structure = jax.tree.structure(like)

    def step(*flat: Array) -> list[Array]:
        return jax.tree.leaves(loop_step(loop, *jax.tree.unflatten(structure, flat)))

    flat = [jnp.asarray(x) for x in jax.tree.leaves(like)]
    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in flat]
    (count,) = export.symbolic_shape("robot")
    many = [jax.ShapeDtypeStruct((count, *x.shape), x.dtype) for x in flat]
    one = export.export(jax.jit(step), platforms=PLATFORMS)(*shapes)
    batch = export.export(jax.jit(jax.vmap(step)), platforms=PLATFORMS)(*many)
    start = {f"start{k}": np.asarray(x) for k, x in enumerate(jax.tree.leaves(state))}
    arrays: dict[str, Any] = start | vars(golden(loop))
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    content = {
        "step.stablehlo": bytes(one.serialize()),
        "step_batch.stablehlo": bytes(batch.serialize()),
        "golden.npz": buffer.getvalue(),
    }
    sums = {name: hashlib.sha256(data).hexdigest() for name, data in content.items()}
    about = {"schema": SCHEMA, "sha256": sums, **asdict(_signature(loop))}
    return {
        **content,
        "step.json": (json.dumps(about, indent=1) + "\n").encode(),
        "README.md": template("stablehlo.md").encode(),
    }


def _signature(loop: ControlLoop[eqx.Module]) -> Signature:
    estimator, controller, reading, estimate = (
        tuple(replace(field, name=f"{struct.name}.{field.name}") for field in struct.fields)
        for struct in structs_of(loop)
    )
    about = "pose and rates in the world [m, m, rad and per s]"
    reference, dt = Field("reference", "real", (6,), about), "time since the last step [s]"
    about = "velocity of the body to drive with instead of the reference, or NaN [m/s, m/s, rad/s]"
    twist = Field("twist", "real", (3,), about)
    command = Field("command", "real", (loop.controller.robot.drives,), "wheel speeds [rad/s]")
    return Signature(
        state=(*estimator, *controller),
        given=(*reading, reference, twist, Field("dt", "real", (), dt)),
        said=(*estimate, command),
    )


def load_program(folder: Path | str) -> Program:
    """Return the step in a folder, after checking that it reproduces the reference steps.

    Raises:
        DataError: a file is absent, damaged or of another version, or results differ from the
            reference steps.
    """
    place = Path(folder)
    expected = f"a file of `slipid export`; {AGAIN}"
    content = {name: read_bytes(place / name, expected) for name in FILES}
    signature = _signature_in(place, content)
    try:
        arrays = arrays_of(content[GOLDEN])
        start, steps = _start_and_steps(signature, arrays)
    except ValueError as error:
        raise DataError(f"{place / GOLDEN}: {error}; {AGAIN}") from error
    programs = []
    for name in PROGRAMS:
        with refused_as(place / name, f"a program; {AGAIN}"):
            programs.append(export.deserialize(bytearray(content[name])))
    program = Program(signature, start, *programs)
    _check_results(program, steps, place)
    return program


def _signature_in(place: Path, content: Mapping[str, bytes]) -> Signature:
    """Return the signature in step.json, after a check of the hashes of the other files.

    A program that was damaged could end the process that loads it, so its hash is compared first.

    Raises:
        DataError: step.json is damaged or of another version, or a file was changed.
    """
    path = place / ABOUT
    try:
        about = json_of(content[ABOUT])
        schema = about.pop("schema", None) if isinstance(about, dict) else None
        if schema != SCHEMA:
            raise ValueError(
                f"the schema is {schema}, but this version of slipid reads {SCHEMA}; update slipid"
            )
        sums, signature = about.pop("sha256", None), typed(Signature, about)
    except ValueError as error:
        raise DataError(f"{path}: {error}, or {AGAIN}") from error
    for name in (GOLDEN, *PROGRAMS):
        found = hashlib.sha256(content[name]).hexdigest()
        if not isinstance(sums, dict) or sums.get(name) != found:
            raise DataError(f"{place / name}: changed, its hash differs from {ABOUT}; {AGAIN}")
    return signature


def _start_and_steps(
    signature: Signature, arrays: Mapping[str, np.ndarray]
) -> tuple[tuple[Array, ...], Golden]:
    """Return the state at rest and the reference steps.

    Raises:
        ValueError: an array is absent or has another shape than by the signature.
    """

    def array(name: str, shape: tuple[int, ...]) -> np.ndarray:
        found = arrays.get(name, np.array("nothing"))
        if found.dtype.kind not in "fiub" or found.shape != shape:
            raise ValueError(f"array {name} of shape {found.shape}; expected {shape}")
        return found

    rows = len(np.atleast_1d(arrays.get("given", 0)))
    fields = signature.said[:-1], signature.said[-1:]
    estimate, command = (sum(field.size for field in some) for some in fields)
    given = sum(field.size for field in signature.given)
    state = enumerate(signature.state)
    start = tuple(jnp.asarray(array(f"start{k}", field.shape)) for k, field in state)
    names = {"given": given, "said": estimate, "command": command}
    return start, Golden(**{name: array(name, (rows, n)) for name, n in names.items()})


def _check_results(program: Program, steps: Golden, place: Path) -> None:
    """Raise `DataError` unless the program reproduces the reference steps, also in a batch."""
    one, two = list(program.start), [jnp.stack([x, x]) for x in program.start]
    count = len(one)
    scale = np.maximum(np.abs(steps.said).max(axis=0), 1e-3)
    for row, estimate, command in zip(steps.given, steps.said, steps.command, strict=True):
        inputs = _split(row, program.signature.given)
        single = program.step.call(*one, *inputs)
        both = program.batch.call(*two, *(jnp.stack([x, x]) for x in inputs))
        one, two = list(single[:count]), list(both[:count])
        for outputs in (single[count:], [x[1] for x in both[count:]]):
            numbers = np.concatenate([np.asarray(x, float).reshape(-1) for x in outputs])
            gap = np.abs(numbers - np.concatenate([estimate, command]))
            if not (gap <= TOLERANCE * np.concatenate([scale, np.ones(len(command))])).all():
                raise DataError(
                    f"{place}: results of the program differ from the reference steps in "
                    f"golden.npz by up to {gap.max():.1e}; export the robot again"
                )


def _split(row: np.ndarray, fields: Sequence[Field]) -> list[Array]:
    parts = np.split(row, np.cumsum([field.size for field in fields])[:-1])
    pairs = zip(parts, fields, strict=True)
    return [jnp.asarray(part.reshape(field.shape)) for part, field in pairs]
