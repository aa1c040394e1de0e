"""The step as StableHLO is the step: for one robot and for many, and it says when it is not."""

from __future__ import annotations

import hashlib
import io
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.deploy.controllers import control_loop_of
from slipid.exports.stablehlo import FILES, SCHEMA, load_program, stablehlo_files
from slipid.lab.trial.controllers import ROWS
from slipid.robot.interface import PERIOD, Readings
from slipid.support.errors import DataError
from tests.helpers import small_twin

LOOP = control_loop_of(small_twin.deployed(1.0, 1.0, 0.3), ROWS["slip_odometry"])


@pytest.fixture(scope="module")
def content():
    return stablehlo_files(LOOP)


@pytest.fixture
def folder(tmp_path, content):
    for name, data in content.items():
        (tmp_path / name).write_bytes(data)
    return tmp_path


@pytest.mark.slow
def test_a_loaded_program_gives_the_results_of_the_control_loop(folder):
    program, count = load_program(folder), 5
    begin, rng = LOOP.init(), np.random.default_rng(0)
    state = begin.estimator, begin.controller
    kept, many = list(program.start), [jnp.stack([x] * count) for x in program.start]
    for k in range(10):
        z = Readings.nothing(3)
        z = z.__class__(**{**vars(z), "wheel_speed": jnp.asarray(rng.normal(size=3))})
        reference = jnp.asarray(rng.normal(size=6))
        estimator, estimate = LOOP.estimator.step(state[0], z, PERIOD)
        if k % 2:
            twist = jnp.full(3, jnp.nan)
            controller, command = LOOP.controller.step(state[1], reference, estimate, PERIOD)
        else:
            twist = jnp.asarray(0.1 * rng.normal(size=3))
            controller, command = LOOP.controller.drive(state[1], twist, estimate, PERIOD)
        state = estimator, controller
        given = [*jax.tree.leaves(z), reference, twist, jnp.asarray(PERIOD)]
        found = program.step.call(*kept, *given)
        both = program.batch.call(*many, *(jnp.stack([x] * count) for x in given))
        wanted = jax.tree.leaves((state, estimate, command))
        for one, several, want in zip(found, both, wanted, strict=True):
            np.testing.assert_allclose(one, want, rtol=1e-12, atol=1e-15)
            np.testing.assert_allclose(several, np.stack([want] * count), rtol=1e-12, atol=1e-15)
        kept, many = list(found[: len(kept)]), list(both[: len(kept)])


@pytest.mark.slow
def test_it_says_what_its_arrays_are(folder):
    program = load_program(folder)
    s = program.signature
    assert [leaf.name for leaf in s.given][-4:] == ["reading.fix_age", "reference", "twist", "dt"]
    assert len(program.step.in_avals) == len(s.state) + len(s.given)
    shapes = [leaf.shape for leaf in (*s.state, *s.given)]
    assert [a.shape for a in program.step.in_avals] == shapes
    assert [a.shape for a in program.step.out_avals] == [x.shape for x in (*s.state, *s.said)]
    assert next(x.about for x in s.given if x.name == "reading.gyro") == "yaw rate [rad/s]"


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_a_lost_or_damaged_file_is_one_sentence(folder, name):
    data = (folder / name).read_bytes()
    (folder / name).write_bytes(data[: len(data) // 3])
    with pytest.raises(DataError, match="export the robot again"):
        load_program(folder)
    (folder / name).unlink()
    with pytest.raises(DataError, match=f"{name}: No such file"):
        load_program(folder)


def test_a_newer_file_is_refused(folder):
    about = json.loads((folder / "step.json").read_text())
    assert about["schema"] == SCHEMA
    about["schema"] = "slipid.stablehlo/4"
    (folder / "step.json").write_text(json.dumps(about))
    with pytest.raises(DataError, match="update slipid"):
        load_program(folder)


@pytest.mark.slow
def test_a_program_that_says_other_numbers_is_refused(folder):
    kept = dict(np.load(folder / "golden.npz"))
    kept["command"][3, 1] += 1e-6
    buffer = io.BytesIO()
    np.savez(buffer, **kept)
    (folder / "golden.npz").write_bytes(buffer.getvalue())
    with pytest.raises(DataError, match=r"golden\.npz: changed"):
        load_program(folder)
    about = json.loads((folder / "step.json").read_text())
    about["sha256"]["golden.npz"] = hashlib.sha256(buffer.getvalue()).hexdigest()
    (folder / "step.json").write_text(json.dumps(about))
    with pytest.raises(DataError, match="results of the program differ"):
        load_program(folder)
