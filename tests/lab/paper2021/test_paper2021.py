"""The 2021 paper regenerated: its pipeline on made data of known truth, its numbers on its own."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slipid.data.log import Log
from slipid.lab.paper2021 import plots as paper_plots
from slipid.lab.paper2021.result import (
    TRACK_FILES,
    SquareTrack,
    TrackFile,
    find_folder,
    read_track,
    regenerate,
)
from slipid.lab.paper2021.samples import (
    FIGURES_3_AND_4,
    SURFACES,
    SlipSamples,
    curve_points,
    effective_speed,
    leave_one_surface_out,
    needed,
    read_columns,
    slip_samples,
    wheel_windows,
)
from slipid.lab.paper2021.table import CURRENT_SVR, TORQUE_SVR, FittedForm, deployed_slip, fit_form
from slipid.support.errors import DataError

RPM = 2 * np.pi / 60
AZIMUTH = np.radians([60.0, 180.0, 300.0])
RIM = np.stack([-np.sin(AZIMUTH), np.cos(AZIMUTH), np.full(3, 0.125)], axis=1)


# made data: rows of a 2021 file in which every wheel's slip and current are known


def made_table(twist, slip, current, command=None):
    """Return columns of a 2021 file: twist (row, 3) in m/s and rad/s, slip and current (row, 3)."""
    command = twist if command is None else command
    speed = twist @ RIM.T / 0.040 * 16 / (1 - slip)
    table = {
        "X axis speed, mm/s": command[:, 0] * 1e3,
        "Y axis speed, mm/s": command[:, 1] * 1e3,
        "Rotational speed, deg/s": np.degrees(command[:, 2]),
        "Delta X, mm": twist[:, 0] * 500,
        "Delta Y, mm": twist[:, 1] * 500,
        "Delta angle, deg": np.degrees(twist[:, 2]) * 0.5,
    }
    for m in range(3):
        table[f"Motor {m + 1} velocity, rpm"] = speed[:, m] / RPM
        table[f"Motor {m + 1} current, A"] = current[:, m]
        table[f"Motor {m + 1} encoder, ticks"] = np.arange(len(twist)) * 100.0
    for name in ("X coordinate, pixels", "Y coodinate, pixels", "Angle, deg"):
        table[name] = np.arange(len(twist)) * 1.0
    return table


def made_rows(rng, rows=60):
    direction = np.radians(rng.uniform(5, 25, rows))
    pace = rng.uniform(0.1, 0.3, rows)
    twist = np.stack([pace * np.cos(direction), pace * np.sin(direction), np.zeros(rows)], axis=1)
    return twist, rng.uniform(0.05, 0.6, (rows, 3)), rng.uniform(0.3, 0.7, (rows, 3))


@pytest.fixture
def rng():
    return np.random.default_rng(2021)


@pytest.mark.parametrize("motor", [1, 2, 3])
def test_known_slip_and_torque_come_back(rng, motor):
    twist, slip, current = made_rows(rng)
    table = made_table(twist, slip, current)
    speed = np.abs(table[f"Motor {motor} velocity, rpm"]) * RPM
    I = current[:, motor - 1]
    torque = 0.0501 * I + 5.3361 * I**2 / speed
    cut = float(np.median(torque))  # so that the cut bites
    got = slip_samples(table, motor, replace(FIGURES_3_AND_4, max_torque=cut))
    keep = torque <= cut
    assert len(got) == 30
    np.testing.assert_allclose(got.slip, slip[keep, motor - 1], rtol=1e-10)
    np.testing.assert_allclose(got.current, I[keep], rtol=1e-12)
    np.testing.assert_allclose(got.torque, torque[keep], rtol=1e-10)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda t: t["Rotational speed, deg/s"].__setitem__(3, 20.0),
        lambda t: t["Motor 1 current, A"].__setitem__(3, 0.25),
        lambda t: t["Motor 1 velocity, rpm"].__setitem__(3, 0.0),
        lambda t: t["Motor 1 velocity, rpm"].__imul__(np.where(np.arange(60) == 3, -1, 1)),
        lambda t: t["Motor 1 velocity, rpm"].__imul__(np.where(np.arange(60) == 3, 0.3, 1)),
        lambda t: t["Delta X, mm"].__setitem__(3, 700.0),
        lambda t: t["Motor 1 current, A"].__setitem__(3, 5.0),
    ],
    ids=["turning", "idle", "at rest", "slip > 1", "slip < 0", "camera jump", "torque"],
)
def test_each_cut_drops_its_row_and_no_other(rng, spoil):
    twist, slip, current = made_rows(rng)
    whole = made_table(twist, slip, current)
    before = slip_samples(whole, 1, FIGURES_3_AND_4)
    assert len(before) == 60
    spoil(whole)
    after = slip_samples(whole, 1, FIGURES_3_AND_4)
    np.testing.assert_array_equal(after.current, np.delete(before.current, 3))


def test_component_without_command_counts_as_zero(rng):
    twist, slip, current = made_rows(rng)
    sideways = twist.copy()
    sideways[:, 1] = 0.05
    command = twist * [1, 0, 0]
    table = made_table(sideways, slip, current, command=command)
    forward_only = command @ RIM.T / 0.040 * 16
    np.testing.assert_allclose(effective_speed(table, FIGURES_3_AND_4), forward_only, rtol=1e-12)


def test_forms_recover_their_coefficients(rng):
    M, I = rng.uniform(0.02, 0.4, 500), rng.uniform(0.3, 1.5, 500)
    truth = {
        "linear in M": 3.2 * M,
        "affine in M": 0.1 + 2.0 * M,
        "quadratic in M": 0.05 + 4.0 * M - 5.0 * M**2,
        "affine in I": 0.08 + 0.5 * I,
        "constant": np.full(500, 0.4),
    }
    expected = [(3.2,), (0.1, 2.0), (0.05, 4.0, -5.0), (0.08, 0.5), (0.4,)]
    for (name, slip), coefficients in zip(truth.items(), expected, strict=True):
        form = fit_form(SlipSamples(I, M, slip), name)
        np.testing.assert_allclose(form.coefficients, coefficients, rtol=1e-9)
        assert form.rmse < 1e-12
        np.testing.assert_allclose(form.slip(M if "M" in name else I), slip, rtol=1e-9)


def test_line_through_the_origin_does_not_bend_to_an_offset(rng):
    M = rng.uniform(0.02, 0.4, 400)
    slip = 0.3 + 0.0 * M
    form = fit_form(SlipSamples(M, M, slip), "linear in M")
    slope = (M @ slip) / (M @ M)
    assert form.coefficients == pytest.approx((slope,), rel=1e-12)
    assert form.rmse == pytest.approx(np.sqrt(np.mean((slip - slope * M) ** 2)), rel=1e-12)
    assert form.slip(np.zeros(1))[0] == 0.0


def test_too_few_samples_are_refused():
    empty = SlipSamples(np.zeros(1), np.zeros(1), np.zeros(1))
    with pytest.raises(ValueError, match="1 samples; expected at least 2"):
        fit_form(empty, "affine in M")


# files


@pytest.mark.parametrize(
    ("text", "fragments"),
    [
        ("", ["empty"]),
        ("time_s,x_mm,y_mm,angle_deg\n0,1,2,3\n1,2\n", ["row 3"]),
        ("time_s,x_mm,y_mm,angle_deg\n0,1,x,3\n", ["row 2", "y_mm", "'x'"]),
        ("time_s,x_mm,y_mm,angle_deg\n0,1,2,3\n1,,2,3\n", ["row 3", "x_mm", "finite"]),
        ("time_s,x_mm,angle_deg\n0,1,2\n", ["y_mm"]),
    ],
    ids=["empty", "ragged", "word", "hole", "column"],
)
def test_broken_file_is_named_with_its_place(tmp_path, text, fragments):
    path = tmp_path / "broken.csv"
    path.write_text(text)
    with pytest.raises(DataError) as refusal:
        read_columns(path, "robotino2021_camera")
    for fragment in ["broken.csv", *fragments]:
        assert fragment in str(refusal.value)


def test_absent_column_and_data_set_are_named(tmp_path, rng):
    (tmp_path / "x.csv").write_text("time_s,x_mm,y_mm,angle_deg\n0,1,2,3\n1,1,2,3\n")
    with pytest.raises(DataError, match=r"x\.csv, column 'Delta Y, mm': no such"):
        read_columns(tmp_path / "x.csv", "robotino2021_camera", ["x_mm", "Delta Y, mm"])
    assert "Delta Y, mm" in needed(FIGURES_3_AND_4)
    with pytest.raises(DataError, match="no 2021 data set; expected robotino2021"):
        find_folder(tmp_path)


def test_short_track_is_refused(tmp_path):
    file = TrackFile("made", "made", "made", 9, 9, 1.0)
    (tmp_path / "figure7").mkdir()
    text = "time_s,x_mm,y_mm,angle_deg\n0,1,2,3\n1,1,2,3\n"
    (tmp_path / "figure7" / "square_made_camera.csv").write_text(text)
    with pytest.raises(DataError, match=r"made_camera\.csv: 2 frames; expected at least the 9"):
        read_track(tmp_path, file)


# stored and deployed models


def test_stored_models():
    line = FittedForm("current", CURRENT_SVR, 0, 0.0)
    np.testing.assert_allclose(line.slip(np.array([0.0, 1.0])), [0.120, 0.686], rtol=1e-12)
    curve = FittedForm("torque", TORQUE_SVR, 0, 0.0)
    np.testing.assert_allclose(curve.slip(np.array([0.0, 0.1])), [-0.072, 0.36224], rtol=1e-12)


def test_deployed_model_as_printed():
    steady = np.array([[0.39] * 3, [1.0] * 3, [2.5] * 3])
    slip = deployed_slip(steady)
    np.testing.assert_array_equal(slip[0], 0.0)
    np.testing.assert_allclose(slip[1], [0.651, 0.4881, 0.6381], rtol=1e-12)
    np.testing.assert_array_equal(slip[2], 1.0)


# tracks


def test_track_numbers_of_a_made_square():
    file = TrackFile("made", "made", "made", 4, 4, 1.0)
    position = np.array([[10.0, 0], [13, 4], [10, 8], [10, 20], [110, 20], [110, 0], [40, 40]])
    heading = np.array([350.0, 355, 360, 365, 370, 372, 375])
    track = SquareTrack(file=file, position=position, heading=heading)
    assert track.path_length == pytest.approx(5 + 5 + 12)
    assert track.displacement == pytest.approx(20.0)
    assert track.closure == pytest.approx(50.0)
    assert (track.heading[0], track.heading[-1]) == (350.0, 375.0)


# transfer between surfaces


def made_log(rng, surface, offset, slope, seconds=12.0):
    """Return a straight run with slip offset + slope I, with a different current for each wheel."""
    time = np.arange(0.0, seconds, 0.03)
    heading = 0.4
    twist = np.array([0.2 * np.cos(0.3), 0.2 * np.sin(0.3), 0.0])
    current = rng.uniform(0.4, 1.1, 3)[None, :] * np.ones((len(time), 1))
    slip = offset + slope * current[0]
    speed = RIM @ twist / 0.040 / (1 - slip)
    c, s = np.cos(heading), np.sin(heading)
    ground = np.array([c * twist[0] - s * twist[1], s * twist[0] + c * twist[1]])
    pose = np.column_stack([time[:, None] * ground, np.full(len(time), heading)])
    nothing = dict.fromkeys(
        ("wheel_speed", "wheel_speed_command", "twist_command", "voltage", "duty", "bus_voltage")
    )
    return Log(
        name=f"{surface}.csv",
        path=Path(f"{surface}.csv"),
        sha256="",
        time=time,
        wheel_angle=time[:, None] * speed,
        current=current,
        current_is_signed=False,
        gyro=None,
        pose=pose,
        pose_fresh=None,
        surface=surface,
        load="as_built",
        **nothing,
    )


def test_windows_find_the_slip_put_in(rng):
    log = made_log(rng, "a", 0.1, 0.5)
    current, slip = wheel_windows(log, FIGURES_3_AND_4)
    assert slip.shape == (23, 3)  # 12 s less 10 mm of start, in whole windows of 0.5 s
    np.testing.assert_allclose(slip, 0.1 + 0.5 * current, rtol=1e-9)
    points = curve_points(log, replace(FIGURES_3_AND_4, min_current=0.0))
    np.testing.assert_allclose(points[:, 1], 0.1 + 0.5 * points[:, 0], rtol=1e-9)
    assert len(points) == 69


def test_windows_leave_resting_wheels_out(rng):
    log = made_log(rng, "a", 0.1, 0.5)
    parked = replace(log, wheel_angle=log.wheel_angle * [1.0, 0.0, 1.0])
    _, slip = wheel_windows(parked, FIGURES_3_AND_4)
    assert np.isnan(slip[:, 1]).all()
    assert np.isfinite(slip[:, [0, 2]]).all()


def test_windows_refuse_a_log_without_pose(rng):
    blind = replace(made_log(rng, "a", 0.1, 0.5), pose=None)
    with pytest.raises(ValueError, match=r"a\.csv: no pose or no current; expected both"):
        wheel_windows(blind, FIGURES_3_AND_4)


def test_transfer_separates_a_common_law_from_one_per_surface(rng):
    common = [made_log(rng, name, 0.1, 0.5) for name in "aabbcc"]
    same = leave_one_surface_out(common)["mean"]
    assert same["pooled"] < 1e-9
    assert same["own"] < 1e-9
    assert same["constant"] > 0.02
    laws = {"a": (0.05, 0.1), "b": (0.2, 0.2), "c": (0.1, 0.6)}
    different = [made_log(rng, name, *laws[name]) for name in "aabbcc"]
    apart = leave_one_surface_out(different)["mean"]
    assert apart["own"] < 1e-9
    assert apart["pooled"] > 0.05


def test_transfer_refuses_too_few_surfaces_or_samples(rng):
    with pytest.raises(ValueError, match="at least two"):
        leave_one_surface_out([made_log(rng, "a", 0.1, 0.5)])


# figures and the report


def write_csv(path, table, delimiter=";"):
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = np.column_stack(list(table.values()))
    np.savetxt(path, rows, delimiter=delimiter, header=delimiter.join(table), comments="")


@pytest.fixture
def made_data(tmp_path, rng):
    folder = tmp_path / "data" / "robotino2021"
    for surface in SURFACES:
        write_csv(folder / f"experimental_data_{surface}.csv", made_table(*made_rows(rng, 120)))
    field = made_table(*made_rows(rng, 120))
    for new, old in (("dX_new", "Delta X, mm"), ("dY_new", "Delta Y, mm")):
        field[new] = field[old]
    field["dANG"] = field["Delta angle, deg"]
    field["Time, ms"] = np.arange(120) * 500.0
    field["Z gyro"] = np.zeros(120)
    write_csv(folder / "experimental_data_on_whole_field.csv", field)
    for file in TRACK_FILES:
        t = np.linspace(0, 1, 400)
        track = {"time_s": 30 * t, "x_mm": 900 * t, "y_mm": 500 * t, "angle_deg": 175 + 10 * t}
        write_csv(folder / "figure7" / f"square_{file.square}_camera.csv", track, delimiter=",")
    return tmp_path / "data"


@pytest.mark.slow
def test_run_writes_report_and_figures(made_data, tmp_path):
    out = tmp_path / "out"
    files = paper_plots.run(made_data, out)
    assert sorted(files) == sorted(out.iterdir())
    assert [f.suffix for f in files] == [".json", ".png", ".png", ".png", ".png"]
    report = json.loads((out / "paper.json").read_text())
    assert report["schema"] == "slipid.paper2021/1"
    assert report["transfer"] is None  # no 2022 runs beside the made set
    assert report["figures3and4"]["motor1"]["n"] == 360
    for file in files[1:]:
        assert file.read_bytes().startswith(b"\x89PNG")


def test_run_leaves_nothing_where_a_file_is_broken(made_data, tmp_path):
    (made_data / "robotino2021" / "experimental_data_red.csv").write_text("a;b\n1;2\n")
    with pytest.raises(DataError, match=r"experimental_data_red\.csv.*column"):
        paper_plots.run(made_data, tmp_path / "out")
    assert not (tmp_path / "out").exists()


# the paper's own data


@pytest.fixture(scope="session")
def folder(real_data):
    folder = real_data / "robotino2021"
    if not folder.is_dir():
        pytest.skip(f"no 2021 data set: {folder} is no folder")
    return folder


@pytest.fixture(scope="session")
def result(folder):
    return regenerate(folder)


PUBLISHED = {
    "linear in M": "0.2311",
    "affine in M": "0.1747",
    "quadratic in M": "0.1514",
    "affine in I": "0.1441",
    "constant": "0.2703",
}


@pytest.mark.parametrize("form", PUBLISHED)
def test_errors_of_motor_1_to_the_digits_given(result, form):
    assert f"{result.motors[1].forms[form].rmse:.4f}" == PUBLISHED[form]


@pytest.mark.parametrize(
    ("motor", "count", "slope"), [(1, 2361, "3.6213"), (2, 1592, "2.7783"), (3, 2410, "3.4683")]
)
def test_samples_and_slopes_to_the_digits_given(result, motor, count, slope):
    table = result.motors[motor]
    assert len(table.samples) == count
    assert f"{table.forms['linear in M'].coefficients[0]:.4f}" == slope
    assert sum(len(part) for part in table.by_surface.values()) == count


def test_torque_predicts_less_than_raw_current(result):
    for table in result.motors.values():
        assert table.forms["affine in I"].rmse < table.forms["affine in M"].rmse


def test_stored_models_on_their_own_points(result):
    # Both lie near the least-squares optimum of their figure, never below it.
    field, motor = result.field, result.motors[1]
    assert f"{field.stored.rmse:.4f}" == "0.2109"
    assert f"{field.forms['affine in I'].rmse:.4f}" == "0.2100"
    assert f"{motor.stored.rmse:.4f}" == "0.2149"


def test_figure_2_line_comes_back_from_a_support_vector_fit(result):
    from sklearn import svm

    x, s = result.field.samples.current, result.field.samples.slip
    quarter, three = np.percentile(s, [25, 75])
    z = (x - x.mean()) / x.std(ddof=1)
    # box and tube as MATLAB's fitrsvm sets them by default, which the authors used
    fit = svm.SVR(kernel="linear", C=(three - quarter) / 1.349, epsilon=(three - quarter) / 13.49)
    fit.fit(z[:, None], s)
    slope = fit.coef_[0, 0] / x.std(ddof=1)
    offset = fit.intercept_[0] - slope * x.mean()
    assert (offset, slope) == pytest.approx(CURRENT_SVR, abs=0.01)


def test_figure_7_tracks(result):
    got = {t.file.name: t for t in result.tracks}
    rows = {
        name: [round(x) for x in (t.displacement, t.closure, t.heading[0], t.heading[-1])]
        for name, t in got.items()
    }
    assert rows["slip_model"] == [762, 1174, 174, 345]
    assert rows["compensation"] == [969, 79, 175, 175]
    # 608 mm, 242 mm and 182 deg, quoted for the encoders, are of another run than this track.
    assert rows["encoders"] == [716, 860, 178, 306]
    lengths = {name: round(t.path_length) for name, t in got.items()}
    assert lengths == {"encoders": 769, "slip_model": 977, "compensation": 1057}
    for t in got.values():
        # summed camera steps carry jitter that the printed lengths, from other columns, do not
        assert 1.0 < t.path_length / t.file.printed_path_length < 1.05


@pytest.mark.slow
def test_no_curve_in_current_carries_over_to_an_unseen_surface(real_data):
    logs = paper_plots.runs_2022(real_data / "robotino2022")
    if logs is None:
        pytest.skip(f"no 2022 runs below {real_data}")
    transfer = leave_one_surface_out(logs)
    assert set(transfer["samples"]) == {"table", "brown", "gray", "green"}
    got = {name: f"{error:.3f}" for name, error in transfer["mean"].items()}
    assert got == {"pooled": "0.221", "constant": "0.226", "own": "0.100"}
    assert transfer["pooled"]["gray"] > 2 * transfer["constant"]["gray"]
