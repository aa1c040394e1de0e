"""`slipid floors`: the floor under each wheel in logged runs, by the camera of a fit."""

from __future__ import annotations

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from slipid.app.floors import _run_floors, summary, write_floors
from slipid.data.floor_map import from_polygons, write_map
from slipid.data.log import Log
from slipid.deploy.floors import FloorLookup
from slipid.model.geometry import omni
from slipid.model.robot import build
from slipid.support.errors import DataError
from tests.helpers.shared import invoke

EDGE = 0.1
"""Edge of the carpet, x [m]."""
COLOURS = {"table": "#ffffff", "carpet": "#206030"}
GLOB = "as_built/soft/run00[0-3].csv"


def half_carpet(path, low=-3.0, high=3.0):
    corners = [(EDGE, low), (high, low), (high, high), (EDGE, high)]
    extent = (low, low, high, high)
    write_map(path, from_polygons("table", [("carpet", corners)], extent), COLOURS)
    return path


def test_a_marker_that_sits_aside_and_is_turned_is_taken_into_account(tmp_path):
    robot = build(omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0), ["soft"], sessions=["day"])
    yaw, aside = 0.4, np.array([0.06, -0.03])
    camera = replace(
        robot.camera,
        scale=jnp.asarray(1.1),
        marker_yaw=jnp.asarray(0.3),
        session_yaw=jnp.array([yaw - 0.3]),
        marker_place=jnp.asarray(aside),
    )
    lookup = FloorLookup.read(half_carpet(tmp_path / "map.toml"))
    heading = np.linspace(-3.0, 3.0, 40)
    logged = np.column_stack([0.05 * np.cos(3 * heading), 0.1 * heading, heading])
    log = Log(
        name="run.csv",
        path=tmp_path / "run.csv",
        sha256="",
        time=np.arange(40.0),
        wheel_angle=np.zeros((40, 3)),
        current_is_signed=True,
        pose=logged,
        pose_fresh=np.arange(40) % 2 == 0,
        surface=None,
        load="as_built",
    )
    found = _run_floors(replace(robot, camera=camera), lookup, log, "day")
    body = heading[::2] - yaw
    c, s = np.cos(body), np.sin(body)
    centre = 1.1 * logged[::2, 0] - (c * aside[0] - s * aside[1])
    wheel = centre[:, None] + 0.125 * np.cos(np.radians([60, 180, 300]) + body[:, None])
    np.testing.assert_array_equal(found.time, np.arange(0.0, 40.0, 2.0))
    np.testing.assert_allclose(found.border, np.abs(wheel - EDGE), atol=0.0045)
    clear = np.abs(wheel - EDGE) > 0.005
    np.testing.assert_array_equal((found.surface == 1)[clear], (wheel > EDGE)[clear])
    beyond = replace(found, inside=np.arange(20)[:, None] < [20, 10, 0])
    shares = summary(lookup, [beyond])
    assert shares["beyond_the_map"] == pytest.approx(0.5)
    on_map = [sum(part) for part in zip(*shares["runs"]["run.csv"].values(), strict=True)]
    assert on_map == pytest.approx([1.0, 0.5, 0.0])
    for _ in range(2):  # an earlier result is replaced
        (path,) = write_floors(tmp_path, lookup, [beyond])
    path.write_text("time,ticks_1\n0.0,1\n")
    with pytest.raises(DataError, match=r"run\.csv: exists and was not written by slipid"):
        write_floors(tmp_path, lookup, [beyond])
    assert path.read_text() == "time,ticks_1\n0.0,1\n"


@pytest.mark.slow
def test_floors_and_borders_are_those_of_the_corrected_poses(small, tmp_path):
    folder, _ = small
    floor, out = half_carpet(tmp_path / "map.toml"), tmp_path / "out"
    words = ("--map", floor, "--data", folder / "logs", "--logs", GLOB, "--out", out)
    done = invoke("floors", folder / "out", *words, "--json", tmp_path / "f.json", "--quiet")
    assert done.exit_code == 0, done.output
    fitted = json.loads((folder / "out" / "identified.json").read_text())["parameters"]
    azimuths = np.radians([60.0, 180.0, 300.0])
    summary = json.loads((tmp_path / "f.json").read_text())
    assert summary["surfaces"] == ["table", "carpet"]
    assert summary["beyond_the_map"] == 0.0
    crossed = 0
    for name, shares in summary["runs"].items():
        rows = pd.read_csv(out / name)
        log = pd.read_csv(folder / "logs" / name)
        first = log[["x", "y"]].to_numpy()[0] / 1000 * fitted["camera.scale"]["value"]
        np.testing.assert_allclose(rows[["x", "y"]].to_numpy()[0], first, atol=2e-4)
        for k, azimuth in enumerate(azimuths):
            x = rows.x + 0.125 * np.cos(azimuth + rows.heading)
            on_carpet = rows[f"floor_{k + 1}"] == "carpet"
            clear = np.abs(x - EDGE) > 0.005
            np.testing.assert_array_equal(on_carpet[clear], (x > EDGE)[clear])
            np.testing.assert_allclose(rows[f"border_{k + 1}"], np.abs(x - EDGE), atol=0.005)
            assert shares["carpet"][k] == pytest.approx(on_carpet.mean(), abs=1e-4)
            crossed += 0.0 < on_carpet.mean() < 1.0
    assert crossed


@pytest.mark.slow
def test_a_map_of_another_frame_is_refused_and_a_small_one_leaves_cells_empty(small, tmp_path):
    folder, _ = small
    words = ("--data", folder / "logs", "--logs", GLOB, "--quiet")
    far = half_carpet(tmp_path / "far.toml")
    far.write_text(far.read_text().replace("corner_m = [-3.0, -3.0]", "corner_m = [47.0, -3.0]"))
    done = invoke("floors", folder / "out", "--map", far, "--out", tmp_path / "far", *words)
    assert done.exit_code == 2
    assert "no wheel of any run is on this map" in done.stderr
    assert not (tmp_path / "far").exists()
    little = half_carpet(tmp_path / "little.toml", -0.15, 0.15)
    done = invoke("floors", folder / "out", "--map", little, "--out", tmp_path / "o", *words)
    assert done.exit_code == 1
    assert "of the wheel positions are outside the map" in done.stdout
    rows = pd.concat([pd.read_csv(path) for path in (tmp_path / "o").rglob("*.csv")])
    outside = rows.floor_1.isna()
    assert 0.0 < outside.mean() < 1.0
    assert rows.border_1[outside].isna().all()
    assert rows.border_1[~outside].notna().all()


@pytest.mark.slow
def test_runs_over_several_floors_have_to_be_named(small, tmp_path):
    folder, _ = small
    words = ("--map", half_carpet(tmp_path / "map.toml"), "--data", folder / "logs")
    done = invoke("floors", folder / "out", *words, "--out", tmp_path / "out", "--quiet")
    assert done.exit_code == 2
    assert "expected the option --logs GLOB" in done.stderr
