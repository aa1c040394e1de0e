"""Evidence of a fit: what a page shows of the logs."""

import numpy as np
import pytest
from scipy.special import fdtri

from slipid.app.config import read_config
from slipid.app.problem import read_fit_task
from slipid.data.floor_map import from_polygons
from slipid.fitting.variances import DEGREES
from slipid.infer.fit_file import load
from slipid.infer.slip_curves import slip_sentence
from slipid.predict.open_loop import replay_windows
from slipid.report.html.evidence import RunEvidence, Track, read_evidence
from slipid.report.html.gather import _map, _travel
from slipid.report.html.sections.predictions import end_error
from slipid.support.progress import Reporter


@pytest.fixture(scope="module")
def made(small):
    """The evidence of a fit, the fit, and its runs."""
    folder, _ = small
    with Reporter(quiet=True) as report:
        task = read_fit_task(read_config(folder / "my.toml"), folder / "logs", report)
    return read_evidence(folder / "out/evidence.json"), load(folder / "out"), task.dataset


@pytest.mark.slow
def test_paths_and_regions_are_those_of_the_fit(made):
    evidence, fit, data = made
    assert [run.name for run in evidence.runs] == [log.name for log in data.logs]
    for w in replay_windows(data, fit.robot):
        pose, scale = fit.contact.body_paths(w)
        for n, k in enumerate(w.run.tolist()):
            run = evidence.runs[k]
            end = run.models["contact"]
            found = np.array([end.x_mm[-1], end.y_mm[-1], end.yaw_mrad[-1]])
            np.testing.assert_allclose(found, 1000 * pose[n, -1], atol=0.51)
            assert run.region is not None
            assert run.region.edge[-1] == len(run.time_s) - 1
            area = run.region.major_mm[-1] * run.region.minor_mm[-1]
            expected = 2e6 * fdtri(2, DEGREES, 0.9) * np.sqrt(np.linalg.det(scale[n, -1]))
            assert area == pytest.approx(expected, rel=0.05)
            assert np.all(np.diff(run.region.major_mm) > -0.2)  # a path becomes more uncertain


@pytest.mark.slow
def test_all_paths_begin_at_the_measured_pose(made):
    for run in made[0].runs:
        for track in run.models.values():
            assert track.x_mm[0] == pytest.approx(run.measured.x_mm[0], abs=3)
            assert track.y_mm[0] == pytest.approx(run.measured.y_mm[0], abs=3)


@pytest.mark.slow
def test_errors_of_quarters_add_up_to_those_of_the_runs(made):
    evidence = made[0]
    q = evidence.quarters
    for k, run in enumerate(evidence.runs):
        mine = [n for n, r in enumerate(q.run) if r == k]
        along = sum(q.along_mm_s[n] * q.seconds[n] for n in mine)
        across = sum(q.across_mm_s[n] * q.seconds[n] for n in mine)
        # straight runs: errors in the body frames of the quarters add up but for the yaw's lever
        whole = 1000 * end_error(run, run.selected)
        assert np.hypot(along, across) < whole + 0.1 * 1000 * run.path_m
        assert sum(q.seconds[n] for n in mine) == pytest.approx(run.seconds, abs=0.05)
    assert all(0 <= h < 360 for h in q.heading_deg if h is not None)


@pytest.mark.slow
def test_currents_are_explained_better_after_the_fit_than_before(made):
    c = made[0].currents
    assert c is not None
    before, after = (np.abs(np.array(x) - np.array(c.measured)).mean() for x in (c.start, c.fitted))
    assert after < 0.5 * before


def test_a_title_claims_what_the_dots_show_and_nothing_else():
    torque = np.linspace(0.0, 1.0, 40)
    noise = np.random.default_rng(0).normal(0, 0.01, 40)
    rising, flat = (torque, 0.3 * torque + noise), (torque, noise)
    both = slip_sentence({"soft": rising, "firm": flat})
    assert both == "The slip of a wheel rises with its torque on soft; no rise shows on firm"
    assert "does not rise" in slip_sentence({"firm": flat})
    assert slip_sentence({"soft": rising}).endswith("on soft")


def test_a_robot_that_turns_while_it_drives_ahead_does_not_drive_backwards():
    yaw = np.linspace(0.0, 4.0, 17)  # an arc of 229 degrees, whose chord points back
    path = np.column_stack([np.sin(yaw), 1 - np.cos(yaw), yaw])
    ahead, left = _travel(path)
    assert ahead == pytest.approx(4.0, rel=0.01)
    assert abs(left) < 1e-9


def test_a_map_is_cut_to_what_its_runs_need():
    run = RunEvidence(
        **{"name": "a", "floor": "soft", "load": "as_built", "heading_deg": None, "speed": None},
        **{"seconds": 1.0, "rest_s": 0.0, "path_m": 1.0, "time_s": [0, 1], "models": {}},
        measured=Track(x_mm=[1000, 2000], y_mm=[0, 0], yaw_mrad=[0, 0]),
        region=None,
        selected="contact",
    )
    corners = [(1.5, -9.0), (9.0, -9.0), (9.0, 9.0), (1.5, 9.0)]
    whole = from_polygons("soft", [("rug", corners)], (-5.0, -5.0, 5.0, 5.0))
    shown = _map(whole, [run])
    assert shown.corner_m == pytest.approx((-0.2, -1.2))
    cells, cell = np.array(shown.cells), shown.cell_m[0]
    assert cells.shape == (200, 200)
    assert cell == pytest.approx(0.017)
    edge = shown.corner_m[0] + cell * np.count_nonzero(cells[0] == 0)
    assert edge == pytest.approx(1.5, abs=cell)
    far = run.model_copy(update={"measured": Track(x_mm=[50000] * 2, y_mm=[0, 0], yaw_mrad=[0, 0])})
    assert _map(whole, [far]).corner_m == (-5.0, -5.0)


def test_slip_rises_with_torque_only_where_torques_differ():
    rng = np.random.default_rng(1)
    torque = 0.06 + 1e-4 * rng.normal(size=60)
    assert "does not rise" in slip_sentence({"carpet": (torque, torque)})
    assert "rises" in slip_sentence({"carpet": (torque - 0.0598, torque)})
