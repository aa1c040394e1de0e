"""The self test: windows with known truth, kept replicates, and its conclusions."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import chi2
from typer.testing import CliRunner

from slipid.app.config import parsed
from slipid.app.logs import packaged_config
from slipid.app.problem import ConfigFitTask
from slipid.cli.main import app
from slipid.fitting import likelihood as lk
from slipid.fitting import noise as of_noise
from slipid.fitting.optimise import Optimum
from slipid.fitting.problem import Problem
from slipid.fitting.shared_effects import AXES
from slipid.lab.selftest import replicates as selftest
from slipid.lab.selftest.experiment import number_summary, summary
from slipid.lab.selftest.replicates import (
    CurveRecovery,
    NumberRecovery,
    Replicate,
    simulate_windows,
)
from slipid.support.checkpoint import Checkpoint
from slipid.support.progress import Reporter
from tests.fitting.test_optimise import begin
from tests.helpers.dense import of_shared
from tests.helpers.made_windows import electric_noise, made, residuals, robot

BENT = eqx.tree_at(
    lambda r: (r.camera.tilt, r.camera.radial, r.camera.tangential, r.motor.current_offset),
    robot(),
    (jnp.array([0.02, -0.03]), jnp.asarray(-0.02), jnp.array([0.01, 0.0]), jnp.asarray(0.03)),
)
STD = {
    "camera.place": 0.0005,
    "camera.heading": 0.003,
    **{f"process.{part}": 0.004 for part in ("along", "across", "yaw")},
    **{f"run.{part}": 0.01 for part in ("along", "across", "yaw")},
    "current.window": 0.05,
    "current.run": 0.04,
    "voltage.window": 0.07,
}


@jax.jit
def gaps(truth, b):
    scatter = np.hypot(STD["current.window"], STD["current.run"])
    return residuals(truth, b, electric_noise(b, STD["voltage.window"], scatter))


def test_a_camera_logs_what_its_correction_undoes():
    pose = jnp.array([0.7, -0.4, 2.0])
    np.testing.assert_allclose(BENT.camera.corrected(BENT.camera.logged(pose)), pose, atol=1e-12)


@pytest.mark.slow
def test_windows_without_noise_are_the_model():
    w = made(BENT, std={}, signed=False)
    for block, r in gaps(BENT, lk.batch(w, BENT)).items():
        assert np.abs(np.asarray(r)).max() < 1e-9, block
    other = made(BENT, std={}, signed=False, seed=1)
    assert np.abs(other.pose[:, 0] - w.pose[:, 0]).max() > 0.1


@pytest.mark.slow
def test_the_noise_made_is_the_noise_the_likelihood_expects():
    def std_of(name):
        head, _, rest = name.partition(".")
        return STD[name] if name in STD else STD.get(f"{head}.{rest.split('.')[-1]}", 0.0)

    driven = made(BENT, std={}, signed=False)
    driven = replace(driven, current_var=np.full_like(driven.current_var, 1e-3))
    rng, square, count = np.random.default_rng(5), {}, 0
    for _ in range(15):
        w = simulate_windows(BENT, driven, rng, STD)
        noise = of_noise.noise(w, BENT)
        variance = np.array([std_of(name) ** 2 for name in noise.names])
        for block, r in gaps(BENT, lk.batch(w, BENT)).items():
            v = np.asarray(noise.blocks[block].covariance(jnp.log(variance + 1e-60)))
            q = np.einsum("ni,nij,nj->n", r, np.linalg.inv(v), np.asarray(r)).sum()
            square[block] = square.get(block, 0.0) + q
            count = 15 * r.size  # 24 pieces of two windows with three numbers, in every block
    low, high = chi2.ppf([1e-4, 1 - 1e-4], count)
    assert set(square) == {"motion", "current", "voltage"}
    assert all(low < q < high for q in square.values()), (square, count)


@pytest.mark.slow
def test_effects_made_are_shared_as_the_likelihood_expects():
    """Against the covariance of all runs together, written out."""
    shared = {f"{kind}.{axis}": 0.02 for kind in ("neighbours", "session") for axis in AXES}
    std = {name: value for name, value in STD.items() if name[0] in "cpr"} | shared
    driven, rng = made(BENT, std={}, signed=False), np.random.default_rng(6)
    problem = Problem(replace(driven, has_current=False, has_voltage=False), BENT, [])
    components = problem.noise.components
    named = [std.get(c.name, std.get(f"{c.kind}.{c.what}", 1e-9)) for c in components]
    log_v = 2 * np.log(named)
    own = np.asarray(problem.covariance("motion", log_v))
    whole = block_diag(*own) + of_shared(problem, log_v)
    root, square = np.linalg.cholesky(whole), 0.0
    for _ in range(15):
        w = simulate_windows(BENT, driven, rng, std)
        r = np.asarray(gaps(BENT, lk.batch(w, BENT))["motion"]).ravel()
        square += float((np.linalg.solve(root, r) ** 2).sum())
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 15 * len(whole))
    assert low < square < high


# what is concluded -------------------------------------------------------------------------------


def number(z=0.5, verdict="identified", inside=True):
    return NumberRecovery("m", [], [2.0], [2.2], inside=[inside], z=[z], verdict=verdict)


@pytest.mark.parametrize(
    ("found", "recovered"),
    [
        ([number()] * 8, "yes"),
        ([number(verdict="weak")] * 5 + [number()] * 3, "roughly"),
        ([number(verdict="not_identified")] * 5 + [number()] * 3, "no"),
        ([number(verdict="weak")] * 4 + [number()] * 4, "roughly"),  # a tie is the worse one
        ([number(z=2.0, inside=False)] * 8, "wrong"),
        ([number(z=6.0, inside=True)] + [number()] * 7, "wrong"),
        ([number(z=1.8, inside=False)] + [number()] * 7, "yes"),  # one of eight may miss
    ],
)
def test_what_counts_as_recovered(found, recovered):
    said = number_summary(found)
    assert said["recovered"] == recovered
    assert said["error_rms"] == pytest.approx(0.2)
    assert said["relative_error_rms"] == pytest.approx(0.1)


def row(verdict, converged=True):
    return Replicate(
        parameters={"a": number(verdict=verdict), "b": number()},
        curves={"soft": CurveRecovery(gap=0.01, inside=0.9)},
        predictions={"soft": {"identified": 0.01, "encoder": 0.3}},
        converged=converged,
    )


def test_only_what_is_wanted_decides():
    rows = [row("not_identified")] * 4
    assert summary(rows, ["b"])["recovered"]
    missed = summary(rows, ["a", "b"])
    assert (missed["recovered"], missed["failed"]) == (False, ["a"])
    assert not summary([row("identified", converged=k > 1) for k in range(4)], ["a"])["recovered"]


# the command -------------------------------------------------------------------------------------

PLAN = """
[selftest]
surfaces = ["soft"]
headings = 6
speeds_m_s = [0.1, 0.3]
turns = 1
"""


def config(folder, more=""):
    text = packaged_config("robotino.toml")
    head, _, _ = text.partition("[selftest]")
    head = head.replace("tolerance = 0.02", "tolerance = 0.1")
    moved = head.index("[[logs]]", head.index("[[logs]]") + 1)
    head = head[:moved] + head[head.index("# Patterns of parameter names") :]
    path = folder / "my.toml"
    path.write_text(head + PLAN + more, encoding="utf-8")
    return path


def invoke(*words):
    return CliRunner().invoke(app, ["selftest", *map(str, words)])


@pytest.fixture(scope="module")
def tested(tmp_path_factory):
    """A self-test that is interrupted after its first replicate, and called again."""
    folder = tmp_path_factory.mktemp("selftest")
    path = config(folder, 'wanted = ["motor.resistance", "motor.back_emf"]')
    out, keep, make, made_once = folder / "out", Checkpoint.save_json, ConfigFitTask.problem, []

    def problem(job):
        """What the first call compiles serves the second."""
        if not made_once:
            made_once.append(make(job))
        return made_once[0]

    def interrupted(*args):
        keep(*args)
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ConfigFitTask, "problem", problem)
        with patch.context() as stop:
            stop.setattr(Checkpoint, "save_json", interrupted)
            stopped = invoke(path, "--out", out, "--replicates", 2)
        left = {p.name: p.read_text() for p in out.iterdir()}
        return out, stopped, left, invoke(path, "--out", out, "--replicates", 2)


@pytest.mark.slow
def test_a_plan_with_voltage_recovers_the_motor(tested):
    out, _, _, result = tested
    assert result.exit_code == 0, result.output
    found = json.loads((out / "selftest.json").read_text(), parse_constant=pytest.fail)
    assert found["schema"] == "slipid.selftest/1"
    assert (found["source"], found["replicates"], found["runs"]) == ("plan", 2, 14)
    for path in ("motor.resistance", "motor.back_emf", "motor.resistance/motor.back_emf"):
        e = found["parameters"][path]
        assert e["recovered"] == "yes"
        assert e["relative_error_rms"] < 0.05
        assert e["truth"][0] != e["truth"][1]  # every replicate has its own truth
    shares = found["parameters"]["robot.load_share@as_built"]
    assert len(shares["labels"]) == 3
    assert shares["intervals"] == 6
    assert found["predictions"]["soft"]["identified"] < found["predictions"]["soft"]["encoder"] / 5
    assert found["curves"]["soft"]["largest_gap"] < 0.1
    assert found["wanted"] == ["motor.resistance", "motor.back_emf"]
    assert "  2 of 2" in result.stderr
    assert "in 90 %" in result.stdout


@pytest.mark.slow
def test_replicates_that_are_done_are_not_repeated(tested):
    out, stopped, left, again = tested
    assert stopped.exit_code == 130
    assert "the same command continues from the last checkpoint" in stopped.stderr
    assert list(left) == ["replicates.json"]
    before = json.loads(left["replicates.json"])["content"]
    assert "1 of 2 replicates are already in" in again.stderr
    after = json.loads((out / "replicates.json").read_text())["content"]
    assert (len(before), len(after)) == (1, 2)
    assert after[0] == before[0]


@pytest.mark.slow
def test_a_replicate_depends_on_seed_and_number_alone(tmp_path, monkeypatch):
    """Whether it is made in one go with others or after an interrupt."""
    truth = robot()
    w = made(truth, std={}, signed=False)
    problem = Problem(w, truth, [])
    config = parsed(Path("my.toml"), packaged_config("robotino.toml"))
    task = Mock(spec=ConfigFitTask, config=config, choices=())
    seen = []
    monkeypatch.setattr(
        selftest, "simulate_windows", lambda t, w, rng, std: seen.append(rng.normal()) or w
    )
    end = Optimum(begin(problem), np.eye(problem.space.size), True, "", ())
    monkeypatch.setattr(selftest, "optimise", lambda *_, **__: end)

    def truth_alone(problem, choices, z, end):
        return Replicate({"z": replace(number(), truth=z.tolist())}, {}, {}, True)

    monkeypatch.setattr(selftest, "recovery", truth_alone)

    def run(count, folder, seed=3):
        kept, report = Checkpoint(tmp_path / folder, "key"), Reporter(quiet=True)
        return selftest.replicates(task, problem, count, seed, kept, report)

    whole = run(4, "whole")
    assert run(2, "left") == whole[:2]
    assert run(4, "left") == whole
    assert seen[:4] == [*seen[4:6], *seen[6:8]]
    assert run(2, "whole") == whole[:2]
    assert len(seen) == 8
    assert run(1, "other", seed=4) != whole[:1]
    spread = np.array([one.parameters["z"].truth for one in whole]) - problem.space.prior_mean
    assert 0.2 < (spread / np.minimum(problem.space.prior_std, 0.5)).std() < 0.8


@pytest.mark.slow
@pytest.mark.parametrize(
    ("more", "said"),
    [
        ('wanted = ["motor.inductance"]', "selftest.wanted 'motor.inductance': not fitted"),
        ('truth = { "motor.rezistance" = 5.5 }', "selftest.truth.'motor.rezistance'"),
        ('truth = { "motor.resistance" = -1.0 }', "motor.resistance = -1.0: expected inside"),
        ("headings = 0", "selftest.headings"),
    ],
)
def test_bad_options_exit_with_2_and_write_nothing(tmp_path, more, said):
    text = PLAN.replace("headings = 6\n", "") if more.startswith("headings") else PLAN
    path = config(tmp_path)
    path.write_text(path.read_text().replace(PLAN, text + more), encoding="utf-8")
    out = tmp_path / "out"
    result = invoke(path, "--out", out)
    assert result.exit_code == 2, result.output
    assert said in result.stderr
    assert not out.exists()
