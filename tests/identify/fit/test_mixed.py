"""Runs over several floors: what they add to a fit, where wheels stand, what configs may say."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2
from typer.testing import CliRunner

from slipid.cli.demo import packaged_config
from slipid.cli.main import app
from slipid.control.interface import MIXED, Settings
from slipid.data.floor_map import from_polygons, uniform
from slipid.data.runs import collect
from slipid.data.windows import Windows
from slipid.deploy.deploy import read_robot
from slipid.identify.fit import crossing as cut
from slipid.identify.fit import likelihood as lk
from slipid.identify.fit import mixed
from slipid.identify.fit_file import load
from slipid.job.config import read_config
from slipid.job.problem import read_job, with_mixed
from slipid.model import se2
from slipid.search_space import Choice, Space
from slipid.selftest.known import Sensors, grid, truth
from slipid.selftest.logs import make_logs
from slipid.support.errors import DataError
from tests.helpers.broken_logs import ROBOTINO, robotino_text, write_good
from tests.helpers.made_logs import write_logs
from tests.helpers.made_windows import robot
from tests.helpers.said import Said
from tests.job.test_config import GOOD, written

NUMBERS = ("friction", "creep", "roller_drag")
CHOICES = [
    Choice("*", free=False),
    *(Choice(f"surface.*.{name}", free=True) for name in NUMBERS),
    Choice("camera.scale", prior_mean=1.1, prior_std=0.002),
]
PLACE, HEADING, CURRENT = 0.0002, 0.0005, 0.05


def made_robot(friction=(0.8, 0.45)):
    blank = robot(loads=("as_built",), sessions=("one",))
    return eqx.tree_at(lambda r: r.surfaces.friction, blank, jnp.asarray(friction))


def still(lag, runs, per_run):
    """Windows of wheels that do not turn, at the origin."""
    n = runs * per_run
    zero = np.zeros((n, 1, 3))
    return Windows(
        run=np.repeat(np.arange(runs), per_run),
        surface=("unknown",) * n,
        load=("as_built",) * n,
        session=("elsewhere",) * n,
        dt=np.full((n, 1), 0.25),
        turn=zero,
        faster=zero,
        pose=np.zeros((n, 2, 3)),
        current=zero,
        voltage=zero,
        current_var=zero + 1e-4,
        has_current=True,
        has_voltage=False,
        current_is_signed=False,
        lag=float(lag),
    )


def crossed(truth_, runs, seed, per_run=40):
    """Windows of wheels that stand on floors drawn at random, with camera and ammeter noise."""
    rng, n = np.random.default_rng(seed), runs * per_run
    way, speed = rng.uniform(0, 2 * np.pi, n), rng.uniform(0.1, 0.25, n)
    xi = np.stack([speed * np.cos(way), speed * np.sin(way), np.zeros(n)], 1)
    rate = xi @ np.asarray(truth_.geometry.forward()).T / 0.04
    floor = rng.integers(2, size=(n, 3))
    pose = np.zeros((n, 2, 3))
    pose[:, 0] = rng.uniform(-0.4, 0.4, (n, 3))
    w = replace(still(truth_.camera.lag, runs, per_run), turn=0.25 * rate[:, None], pose=pose)

    @jax.jit
    def seen(b):
        p = lk.predict(truth_, b)
        start = jax.vmap(truth_.camera.corrected)(b.pose[:, 0])
        end = jax.vmap(se2.compose)(start, p.increment[:, 0])
        return jax.vmap(truth_.camera.logged)(end), lk.predicted_current(truth_, b, p.felt)

    end, amps = seen(lk.batch(w, truth_, floor))
    pose[:, 1] = end
    pose += rng.normal(size=pose.shape) * [PLACE, PLACE, HEADING]
    w = replace(w, pose=pose, current=np.asarray(amps) + CURRENT * rng.normal(size=amps.shape))
    runs_ = tuple((f"site/run{k}.csv", f"{k:x}") for k in range(runs))
    return cut.Crossing(w, floor, np.tile(np.arange(per_run), runs), runs_)


@pytest.fixture(scope="module")
def learnt():
    """Truth, a prior that knows all but how hard each floor grips, and what the windows add."""
    true = made_robot()
    space = Space(true, CHOICES)
    z = space.vector(true)
    flat = np.zeros((2, space.size))
    for k, floor in enumerate(("firm", "soft")):
        for name, power in zip(NUMBERS, (1.0, 1.0, -1.0), strict=True):
            flat[k, space.place[f"surface.{floor}.{name}"]] = power
    std = np.where(mixed.held(space), space.prior_std, 0.02)
    covariance = np.diag(std**2) + 0.8**2 * flat.T @ flat
    mean = z - 0.7 * flat[0] + 0.9 * flat[1]
    return (
        true,
        space,
        z,
        mean,
        covariance,
        mixed.update(space, mean, covariance, [crossed(true, 12, 1), crossed(true, 4, 2)]),
    )


@pytest.mark.slow
def test_what_one_floor_leaves_open_several_tell(learnt):
    _, space, z, _, covariance, found = learnt
    assert found.settled
    moved = ~mixed.held(space)
    away = (found.z - z)[moved]
    assert away @ np.linalg.inv(found.covariance[np.ix_(moved, moved)]) @ away < chi2(6).ppf(0.999)
    for floor in ("firm", "soft"):
        at = space.place[f"surface.{floor}.friction"].start
        assert np.sqrt(found.covariance[at, at]) < 0.15 * np.sqrt(covariance[at, at])
    assert len(found.runs) == found.about["runs"] == 16
    assert found.about["windows"] == 640


def test_left_out_halves_are_predicted_down_to_the_noise(learnt):
    about = learnt[-1].about
    noise = np.sqrt(2) * np.array([1.1 * PLACE, HEADING]) / 0.25
    assert about["before"]["yaw_rate"] > 2 * noise[1]
    assert about["after"]["yaw_rate"] == pytest.approx(noise[1], rel=0.1)
    assert about["after"]["speed"] == pytest.approx(np.sqrt(2) * noise[0], rel=0.2)
    assert about["after"]["current"] == pytest.approx(CURRENT, rel=0.1)
    assert max(about["correlation"].values()) < 1.6
    std = {name: np.sqrt(v) for name, v in learnt[-1].variance.items()}
    assert std["mixed.current"] == pytest.approx(CURRENT, rel=0.2)
    assert set(learnt[-1].unit) == set(std)


def test_the_camera_stays_as_the_first_fit_left_it(learnt):
    _, space, _, mean, covariance, found = learnt
    held = mixed.held(space)
    assert held.sum() == 1
    np.testing.assert_array_equal(found.z[held], mean[held])
    np.testing.assert_array_equal(found.covariance[held][:, held], covariance[held][:, held])


def test_its_uncertainty_is_carried_along():
    space = Space(made_robot(), CHOICES)
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, space.size, space.size))
    covariance, information = a @ a.T, b @ b.T
    h, new = mixed.held(space), mixed.informed(space, covariance, information)
    np.testing.assert_allclose(new, new.T)
    assert np.linalg.eigvalsh(new).min() > 0
    # given the camera: as if it were known
    given = np.linalg.inv(np.linalg.inv(new)[np.ix_(~h, ~h)])
    total = np.linalg.inv(covariance) + information
    np.testing.assert_allclose(given, np.linalg.inv(total[np.ix_(~h, ~h)]), rtol=1e-8)


def test_a_single_run_judges_nothing(learnt):
    _, space, _, mean, covariance, _ = learnt
    several = crossed(made_robot(), 2, 3)
    one = replace(several.of(several.windows.run == 0), runs=several.runs[:1])
    found = mixed.update(space, mean, covariance, [one])
    assert found.about["after"] is None
    assert found.about["runs"] == 1


@pytest.mark.parametrize(("keep", "worth"), [(0.0, 1.0), (0.6, 4.0)])
def test_correlated_windows_count_for_fewer(keep, worth):
    """A first-order process with correlation a is worth (1 - a) / (1 + a) of its samples."""
    rng = np.random.default_rng(1)
    x = rng.normal(size=(60, 200))
    for k in range(1, 200):
        x[:, k] = keep * x[:, k - 1] + np.sqrt(1 - keep**2) * x[:, k]
    x[rng.random(x.shape) < 0.2] = np.nan
    run, place = (i.ravel() for i in np.indices(x.shape))
    assert cut._dilution(x.ravel(), run, place) == pytest.approx(worth, rel=0.2)
    picked = np.isfinite(x.ravel())  # gaps are gaps, however they are told
    same = cut._dilution(x.ravel()[picked], run[picked], place[picked])
    assert same == pytest.approx(cut._dilution(x.ravel(), run, place))


# where wheels stand -----------------------------------------------------------------------------


def test_wheels_stand_where_the_camera_says_less_the_marker():
    true = made_robot()
    true = eqx.tree_at(lambda r: r.camera.marker_yaw, true, jnp.asarray(0.1))
    w = still(0.0, 1, 1)
    x, y, heading = 0.3, -0.2, np.pi / 2
    px, py = np.asarray(true.camera.marker_place)
    marker = jnp.array([x - py, y + px, heading + 0.1])
    logged = np.asarray(true.camera.logged(marker))
    found = cut.wheel_places(true, replace(w, pose=np.tile(logged, (1, 2, 1))))
    place = 0.125 * np.asarray(true.geometry.place)
    expected = np.stack([x - place[:, 1], y + place[:, 0]], 1)
    assert found.shape == (1, 3, 3, 2)
    np.testing.assert_allclose(found[0], np.tile(expected, (3, 1, 1)), atol=1e-6)


@pytest.fixture(scope="module")
def driven():
    drives = grid(setups=(("soft", "as_built"), ("firm", "as_built")), headings=2, turns=0)
    true = truth(drives)
    logs = [replace(log, surface=None) for log in make_logs(true, drives, 1, Sensors())]
    return true, collect(logs)


RIGHT = [[0.0, -9.0], [9.0, -9.0], [9.0, 9.0], [0.0, 9.0]]


def test_windows_in_which_no_wheel_changes_floors(driven):
    true, data = driven
    half = from_polygons("soft", [("firm", RIGHT)], (-3.0, -3.0, 3.0, 3.0))
    whole = cut.crossing(data, uniform("soft", 3.0), true)
    some = cut.crossing(data, half, true)
    assert set(whole.floor.ravel()) == {true.surface_index("soft")}
    assert len(some.windows) < len(whole.windows)
    x = cut.wheel_places(true, some.windows)[..., 0]
    assert ((x > 0) == (some.floor == true.surface_index("firm"))[:, None]).all()
    assert whole.windows.dt.max() < 2 * cut.WINDOW
    assert (np.diff(whole.place)[np.diff(whole.windows.run) == 0] > 0).all()
    rim = 0.04 * np.abs(whole.windows.turn[:, 0]) / whole.windows.dt
    assert rim.max(axis=1).min() >= cut.LEAST_SPEED


def test_runs_without_a_window_are_refused(driven, monkeypatch):
    true, data = driven
    monkeypatch.setattr(cut, "LEAST_SPEED", 9.0)
    with pytest.raises(DataError, match=r"no 0\.25 s in which .*expected larger patches"):
        cut.crossing(data, uniform("soft", 3.0), true)


# configs ----------------------------------------------------------------------------------------

SITE = (
    '[[logs]]\nglob = "site/*.csv"\nformat = "robotino2022"\nmap = "maps/site.toml"\n[parameters]'
)
MAP = 'schema = "slipid.map/1"\nbase = "gray"\nextent_m = [-2, -2, 2, 2]\n'


@pytest.fixture
def folder(tmp_path):
    write_good(tmp_path)
    for path, text in (
        ("site/exp01.csv", robotino_text(heading=70)),
        ("maps/site.toml", MAP),
    ):
        (tmp_path / path).parent.mkdir()
        (tmp_path / path).write_text(text, encoding="utf-8")
    return tmp_path


def mixed_job(folder: Path, text: str, said=None):
    said = said or Said()
    return with_mixed(read_job(read_config(written(folder, text)), folder, said), folder, said)


def test_runs_with_a_map_are_kept_apart(folder):
    job = mixed_job(folder, GOOD.replace("[parameters]", SITE))
    assert [log.name for log in job.dataset.logs] == [ROBOTINO]
    ((data, floor),) = job.mixed
    assert floor.surfaces == ("gray",)
    assert [(log.name, log.surface) for log in data.logs] == [("site/exp01.csv", None)]
    assert [log.name for log in job.logs] == [ROBOTINO, "site/exp01.csv"]
    assert job.data_hash != mixed_job(folder, GOOD).data_hash


def test_a_set_with_a_map_and_no_files_is_skipped(folder):
    said = Said()
    job = mixed_job(folder, GOOD.replace("[parameters]", SITE.replace("site/", "far/")), said)
    assert job.mixed == ()
    assert len(said.lines) == 1
    assert said.lines[0].startswith("skipped: ")
    assert job.skipped == tuple(said.lines)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (("maps/site.toml", "none.toml"), r"none\.toml: No such file.*expected a floor map"),
        (("site/*", "one_surface/gray/*"), "found by two globs of .*my.toml; expected it once"),
        (("map =", 'load = "far"\nmap ='), "load set-up 'far'.*expected one of as_built"),
        (("map =", 'surface = "gray"\nmap ='), "surface and map at once"),
        (("map =", "maps ="), "did you mean map"),
    ],
)
def test_mistakes_with_maps_are_named(folder, change, expected):
    assert change[0] in SITE
    with pytest.raises(DataError, match=expected):
        mixed_job(folder, GOOD.replace("[parameters]", SITE.replace(*change)))


def test_every_floor_of_a_map_needs_runs_of_its_own(folder):
    path = folder / "maps/site.toml"
    path.write_text(MAP.replace("gray", "sand"), encoding="utf-8")
    with pytest.raises(DataError, match=r"site\.toml: surface 'sand'.*expected some of gray"):
        mixed_job(folder, GOOD.replace("[parameters]", SITE))


def test_a_config_needs_runs_on_one_floor(folder):
    head = GOOD[: GOOD.index("[[logs]]")]
    with pytest.raises(DataError, match="every section has a map; expected one without"):
        read_config(written(folder, head + SITE))


# the whole way ----------------------------------------------------------------------------------


def invoke(*words):
    return CliRunner().invoke(app, [str(w) for w in words])


@pytest.mark.slow
def test_identify_learns_from_them_and_later_commands_know(tmp_path):
    drives = grid(setups=(("soft", "as_built"),), headings=6, speeds=(0.1, 0.3), turns=0)
    true = truth(drives)
    write_logs(make_logs(true, drives, 1, Sensors()), true, tmp_path / "logs", tmp_path / "t")
    write_logs(make_logs(true, drives[:4], 2, Sensors()), true, tmp_path / "site", tmp_path / "t")
    (tmp_path / "site/as_built/soft").rename(tmp_path / "logs/site")
    (tmp_path / "site.toml").write_text(MAP.replace("gray", "soft"), encoding="utf-8")
    section = '[[logs]]\nglob = "site/*.csv"\nformat = "demo"\nmap = "site.toml"\n[parameters]'
    text = packaged_config("robotino.toml").replace("[parameters]", section)
    config, out = written(tmp_path, text), tmp_path / "out"
    said = invoke("identify", config, "--data", tmp_path / "logs", "--out", out)
    assert said.exit_code == 0, said.stderr
    assert "4 runs over several floors: predicted within" in said.stderr
    fit = load(out)
    assert fit.converged
    assert len(fit.runs) == 16
    assert fit.mixed["runs"] == 4
    assert fit.refused is None
    assert not fit.mixed["floors"]["soft"]["is_worse"]
    assert {"mixed.along", "mixed.across", "mixed.yaw", "mixed.current"} < set(fit.variance)
    run = json.loads((out / "run.json").read_text())
    assert run["data"]["hash"] == fit.data_hash
    assert len(run["data"]["logs"]) == 16
    judged = invoke("validate", out, "--data", tmp_path / "logs", "--json", tmp_path / "v.json")
    assert judged.exit_code == 0, judged.stderr
    assert len(json.loads((tmp_path / "v.json").read_text())["runs"]) == 12
    drawn = invoke("sample", out)
    assert drawn.exit_code == 2
    assert "runs over several floors, which are not sampled yet" in drawn.stderr
    deployed(out)


def deployed(out):
    """The fit drives its twin; what is done is not done again."""
    fit = load(out)
    robot = read_robot(out)
    assert Settings.of(robot).alike == MIXED
    assert fit.current_trend != (0.0, 0.0)
    np.testing.assert_array_equal(robot.current_trend, fit.current_trend)
    wish = ("trial", out, "--plant", "twin", "--starts", 2, "--jobs", 1)
    wish = (*wish, "--controllers", "encoder,contact", "--json", out / "t.json")
    first = invoke(*wish)
    assert first.exit_code == 0, first.stderr
    said = json.loads((out / "t.json").read_text())
    assert said["closes_best"] == "contact"
    encoder, contact = (said["summary"][name] for name in ("encoder", "contact"))
    assert contact["closure_error_median"] < encoder["closure_error_median"]
    assert encoder["first_side_along_track_mm"] > 20  # it slips
    assert (out / "trial.png").stat().st_size > 10_000
    again = invoke(*wish)
    assert "driving 0 of 4 runs" in again.stderr
    assert json.loads((out / "t.json").read_text())["runs"] == said["runs"]


@pytest.mark.slow
def test_runs_with_a_wrong_map_are_refused(tmp_path):
    """They were driven on `soft`, and their map says `firm`."""
    drives = grid(
        setups=(("soft", "as_built"), ("firm", "as_built")), headings=6, speeds=(0.1, 0.3), turns=0
    )
    true = truth(drives)
    write_logs(make_logs(true, drives, 1, Sensors()), true, tmp_path / "logs", tmp_path / "t")
    soft = [d for d in drives if d.surface == "soft"]
    write_logs(make_logs(true, soft, 2, Sensors()), true, tmp_path / "site", tmp_path / "t")
    (tmp_path / "site/as_built/soft").rename(tmp_path / "logs/site")
    (tmp_path / "site.toml").write_text(MAP.replace("gray", "firm"), encoding="utf-8")
    section = '[[logs]]\nglob = "site/*.csv"\nformat = "demo"\nmap = "site.toml"\n[parameters]'
    text = packaged_config("robotino.toml").replace("[parameters]", section)
    config, out = written(tmp_path, text), tmp_path / "out"
    said = invoke("identify", config, "--data", tmp_path / "logs", "--out", out)
    assert said.exit_code == 0, said.stderr
    assert "were not learnt from: they contradict those on one floor" in said.stderr
    fit = load(out)
    assert fit.mixed is None
    assert fit.refused["reason"] in fit.messages
    errors = fit.refused["floors"]["firm"]
    assert errors["is_worse"]
    assert errors["after"] > 1.5 * errors["before"]
    assert len(fit.runs) == 24  # those on one floor
    assert not any(name.startswith("mixed.") for name in fit.variance)
