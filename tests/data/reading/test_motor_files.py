"""Logs of motors in the layouts of other tools, in one or several files, and damaged ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slipid.app.bench import read_motor_log
from slipid.data.reading.motor_layout import MotorOptions, given_columns
from slipid.data.reading.units import converts
from slipid.data.reading.wpilog import read_wpilog
from slipid.infer.bench.motor import BenchRecord
from slipid.support.errors import DataError
from tests.helpers import motor_layouts as made
from tests.helpers.damaged_files import damaged
from tests.helpers.motor_layouts import LAYOUTS, MotorLayout

DAMAGES = 200
"""Number of damages of each file."""


def read(path: Path, options: MotorOptions | None = None, **columns: str) -> list[BenchRecord]:
    """The records of a single motor, with columns given like options of the command."""
    given = {channel: given_columns(text, channel) for channel, text in columns.items()}
    task = read_motor_log(path, given, None, options or MotorOptions())
    assert [*task.records] == [""]
    return [*task.records[""]]


def read_layout(folder: Path, layout: MotorLayout) -> list[BenchRecord]:
    """Read a layout's file in a folder; an oscilloscope's with the log beside it."""
    path = folder / layout.name
    if not layout.voltage:
        return read(path, layout.options)
    return read(folder / "main.csv", layout.options, voltage=f"{path}::{layout.voltage}")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a file of each layout."""
    path = tmp_path_factory.mktemp("layouts")
    made.without_voltage(path / "main.csv", made.signals())
    for layout in LAYOUTS:
        step = 1e-3 if layout.voltage else made.STEP
        rows = round(made.ROWS * made.STEP / step)
        layout.write(path / layout.name, made.signals(rows=rows, step=step))
    return path


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda one: one.name)
def test_every_layout_is_read_as_it_is(folder, layout):
    records = read_layout(folder, layout)
    assert len(records) == layout.tests
    time = np.concatenate([r.time for r in records])
    assert len(time) >= 0.99 * made.ROWS
    s = made.signals()
    for name, tolerance in (("voltage", 0.02), ("current", 0.01), ("speed", 0.2)):
        if name == "current" and not layout.current:
            assert all(r.current is None for r in records)
            continue
        known = np.interp(time, s.time, getattr(s, name))
        values = np.concatenate([getattr(r, name) for r in records])
        inner = slice(1, -1) if layout.voltage else slice(None)
        np.testing.assert_allclose(values[inner], known[inner], atol=tolerance)


def test_tests_are_records_with_their_names(folder):
    names = [r.name for r in read(folder / "sysid.csv")]
    assert names == [f"sysid.csv: {test}" for test in made.TESTS]
    assert [r.name.split(": ")[1] for r in read(folder / "sysid.wpilog")] == [*made.TESTS]
    assert [r.name.split(": ")[1] for r in read(folder / "sysid.json")] == [*made.OLD_TESTS]


def refusal(folder: Path, layout: MotorLayout) -> str:
    """The message with which a file is refused, empty if it is read."""
    try:
        read_layout(folder, layout)
    except DataError as error:
        return str(error)
    return ""


@pytest.mark.slow
@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda one: one.name)
def test_a_damaged_file_is_refused_by_its_name_or_read(layout, tmp_path):
    made.without_voltage(tmp_path / "main.csv", made.signals(rows=60))
    path = layout.write(tmp_path / layout.name, made.signals(rows=60))
    good, messages = path.read_bytes(), []
    for seed in range(DAMAGES):
        path.write_bytes(damaged(good, seed))
        try:
            messages.append(refusal(tmp_path, layout))
        except Exception as error:
            raise AssertionError(f"damage {seed}") from error
    refused = [one for one in messages if one]
    assert 0.3 * DAMAGES < len(refused) < DAMAGES
    assert [one for one in refused if layout.name not in one or "; expected " not in one] == []


def test_a_time_of_day_goes_on_after_midnight(tmp_path):
    path = made.vesc(tmp_path / "vesc.csv", made.signals(), start_ms=86_400_000 - 7000)
    (record,) = read(path, MotorOptions(pole_pairs=7.0))
    assert np.diff(record.time) == pytest.approx(made.STEP, abs=1e-6)
    s = made.signals()
    np.testing.assert_allclose(record.speed, s.speed, atol=1e-4)


@pytest.mark.parametrize(("channel", "column"), [("duty", "duty_cycle"), ("bus_voltage", "")])
def test_a_given_channel_replaces_its_alternatives(tmp_path, channel, column):
    path = made.vesc(tmp_path / "vesc.csv", made.signals())
    options = MotorOptions(pole_pairs=7.0)
    given = {channel: given_columns(column or "input_voltage", channel)}
    task = read_motor_log(path, given, None, options)
    assert {line.split(":")[0] for line in task.columns_used} == {
        *("duty", "time", "current", "speed", "bus_voltage")
    }
    (record,) = task.records[""]
    np.testing.assert_allclose(record.voltage, made.signals().voltage, atol=1e-6)


def test_an_ignored_column_is_not_searched_for(tmp_path):
    path = made.vesc(tmp_path / "vesc.csv", made.signals())
    # a column that is ignored is not searched for: the tool's other columns are taken instead
    ignoring = MotorOptions(pole_pairs=7.0, ignored=frozenset({"q_axis_voltage"}))
    used = read_motor_log(path, {}, None, ignoring).columns_used
    assert "current: current_motor [A]" in used
    with pytest.raises(DataError, match="no column 'q_axis' to ignore, did you mean q_axis_"):
        read(path, MotorOptions(pole_pairs=7.0, ignored=frozenset({"q_axis"})))


def test_a_duty_cycle_needs_the_bus_voltage(tmp_path):
    path = made.plain(tmp_path / "log.csv", made.signals())
    with pytest.raises(DataError, match=r"a duty cycle, but no column .*; expected --bus"):
        read(path, duty="U:%")


def test_an_ignored_column_leaves_one_motor(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,U,I,w,w_2\n" + "".join(f"{k},1,2,{k},3\n" for k in range(20)))
    with pytest.raises(DataError, match=r"different numbers of motors .*--ignore"):
        read_motor_log(path, {"voltage": given_columns("U,I", "voltage")}, None, MotorOptions())
    (record,) = read(path, MotorOptions(ignored=frozenset({"w_2"})))
    assert record.speed[3] == pytest.approx(3.0)


def test_a_fast_channel_is_averaged_around_each_row(tmp_path):
    main = made.without_voltage(tmp_path / "main.csv", made.signals())
    s = made.signals(start=5.5, rows=5000, step=1e-3)
    # the ripple of a PWM is larger than the voltage, and its mean is zero
    ripple = 20 * (-1.0) ** np.arange(5000)
    time = [s.time, s.voltage + ripple]
    scope = tmp_path / "scope.csv"
    np.savetxt(scope, np.stack(time, 1), delimiter=",", header="Time,A", comments="")
    (record,) = read(main, voltage=f"{scope}::A")
    assert record.time[0] == pytest.approx(5.5, abs=0.021)
    assert record.time[-1] == pytest.approx(10.5, abs=0.021)
    known = made.signals()
    inner = record.time[1:-1]
    volts = np.interp(inner, known.time, known.voltage)
    np.testing.assert_allclose(record.voltage[1:-1], volts, atol=0.05)
    speed = np.interp(inner, known.time, known.speed)
    np.testing.assert_allclose(record.speed[1:-1], speed, atol=1e-4)


def test_an_oscilloscope_of_a_megahertz_is_averaged(tmp_path):
    main = made.without_voltage(tmp_path / "main.csv", made.signals(start=0.0, rows=20))
    s = made.signals(start=0.0, rows=200_000, step=1e-6)
    scope = made.rigol(tmp_path / "scope.csv", s)
    (record,) = read(main, voltage=f"{scope}::CH1")
    assert len(record.time) == 9
    volts = np.interp(record.time, s.time, s.voltage)
    np.testing.assert_allclose(record.voltage[1:-1], volts[1:-1], atol=1e-3)


def test_clocks_that_do_not_overlap_are_refused_with_their_ranges(tmp_path):
    main = made.without_voltage(tmp_path / "main.csv", made.signals())
    scope = made.siglent(tmp_path / "scope.csv", made.signals(start=100.0))
    message = r"do not overlap: .*main.csv 5 to 12.98 s, .*scope.csv 100 to 107.98 s; expected"
    with pytest.raises(DataError, match=message):
        read(main, voltage=f"{scope}::CH1")
    with pytest.raises(DataError, match=r"none.csv: cannot be read \(No such file"):
        read(main, voltage=f"{tmp_path / 'none.csv'}::CH1")


def pulses(s: made.Signals, per_revolution: float) -> np.ndarray:
    """The number of pulses until each row, in both directions."""
    turned = np.concatenate([[0.0], np.cumsum(0.5 * np.abs(s.speed[1:] + s.speed[:-1]))])
    return np.floor(turned * (s.time[1] - s.time[0]) * per_revolution / made.TURN)


@pytest.mark.parametrize("kind", ["count", "level", "times"])
def test_the_speed_from_pulses_has_the_sign_of_the_voltage(tmp_path, kind):
    s = made.signals(rows=8000, step=1e-3)
    count = pulses(s, 20)
    header, columns = "t,U", [s.time, s.voltage]
    pulse = "N"
    if kind == "times":
        new = np.flatnonzero(np.diff(count) > 0) + 1
        beside = tmp_path / "pulses.csv"
        np.savetxt(beside, 1e3 * s.time[new], header="pulse", comments="", fmt="%.6f")
        pulse = f"{beside}::pulse:ms"
    else:
        header += ",N"
        columns.append(count if kind == "count" else 5.0 * (count % 2))
    path = tmp_path / "log.csv"
    np.savetxt(path, np.stack(columns, 1), delimiter=",", header=header, comments="")
    # every second pulse of the count is a rising edge of the level
    options = MotorOptions(pulses_per_revolution=10.0 if kind == "level" else 20.0, gear_ratio=2.0)
    (record,) = read(path, options, pulses=pulse)
    fast = np.abs(np.interp(record.time, s.time, s.speed)) > 40
    ratio = record.speed[fast] / (2 * np.interp(record.time[fast], s.time, s.speed))
    assert (ratio > 0).all()
    assert np.median(ratio) == pytest.approx(1.0, abs=0.02)


def test_pulses_need_their_number_and_a_voltage(tmp_path):
    path = made.plain(tmp_path / "log.csv", made.signals(rows=2000))
    with pytest.raises(DataError, match="only one of --pulses and --pulses-per-revolution"):
        read(path, pulses="w")
    options = MotorOptions(pulses_per_revolution=2.0, ignored=frozenset({"U"}))
    with pytest.raises(DataError, match="pulses have no direction"):
        read(path, options, pulses="w")
    with pytest.raises(DataError, match=r"--gear: 0; expected a number from 0\.001 to"):
        MotorOptions(gear_ratio=0.0)


def test_the_time_of_another_file_can_be_named(tmp_path):
    s = made.signals()
    main = made.without_voltage(tmp_path / "main.csv", s)
    other = tmp_path / "other.csv"
    np.savetxt(
        other, np.stack([1e3 * s.time, s.voltage], 1), delimiter=",", header="a,b", comments=""
    )
    with pytest.raises(DataError, match=r"other.csv: no column for the time among a, b"):
        read(main, voltage=f"{other}::b")
    (record,) = read(main, voltage=f"{other}::b:V", time=f"{other}::a:ms")
    np.testing.assert_allclose(record.voltage, s.voltage, atol=1e-6)


def test_a_test_of_a_single_row_is_left_out(tmp_path):
    path = made.sysid_csv(tmp_path / "log.csv", made.signals())
    lines = path.read_text().splitlines()
    path.write_text(
        "\n".join([*lines[:2], lines[2].replace("quasistatic-forward", "x"), *lines[3:]])
    )
    assert [r.name.split(": ")[1] for r in read(path)] == [*made.TESTS]


def test_a_unit_with_a_tower_of_powers_is_no_unit():
    assert given_columns("w:10**10**10", "time").unit is None
    assert converts("m**2/m", "m")


def test_a_gear_and_a_reversed_sign(tmp_path):
    s = made.signals()
    path = made.plain(tmp_path / "log.csv", s)
    given = {"motor_speed": given_columns("w:-rpm", "motor_speed")}
    task = read_motor_log(path, given, None, MotorOptions(gear_ratio=3.0))
    np.testing.assert_allclose(
        task.records[""][0].speed, -3 * s.speed * made.TURN / 60, rtol=1e-6, atol=1e-6
    )
    (line,) = (line for line in task.columns_used if line.startswith("speed"))
    assert line == "speed: w [rpm] times the gear ratio 3, taken as that of the motor's shaft"


def test_a_reversed_voltage_without_a_current_is_refused_with_its_column(tmp_path):
    path = made.sysid_csv(tmp_path / "log.csv", made.signals())
    with pytest.raises(DataError, match=r"opposes the speed .*voltage: Volts \(V\) \[V\]"):
        read(path, voltage="Volts:-V")


def test_a_speed_in_metres_is_refused(tmp_path):
    path = made.sysid_csv(tmp_path / "log.csv", made.signals())
    path.write_text(path.read_text().replace("rot", "m"))
    with pytest.raises(DataError, match=r"'Velocity \(m/s\)': the unit 'm/s' of the speed"):
        read(path)


def test_both_sides_of_a_drivetrain_are_motors(tmp_path):
    path = made.drivetrain_json(tmp_path / "drive.json", made.signals())
    left, right = read_motor_log(path, {}, None, MotorOptions()).records.values()
    np.testing.assert_allclose(right[0].speed, left[0].speed / 2)
    np.testing.assert_allclose(right[0].voltage, left[0].voltage / 2)


def test_entries_of_a_data_log_are_chosen_by_their_names(tmp_path):
    names = {"voltage": "NT:/drive/volts", "position": "NT:/a", "velocity": "NT:/drive/turns"}
    path = made.wpilog(tmp_path / "log.wpilog", made.signals(), names)
    records = read(path, voltage="NT:/drive/volts", motor_speed="NT:/drive/turns")
    assert [len(r.time) for r in records] == pytest.approx(4 * [100], abs=2)
    with pytest.raises(DataError, match=r"column 'blob'|no column 'blob'"):
        read(path, voltage="blob", motor_speed="NT:/drive/turns")
    with pytest.raises(DataError, match="column 'sysid-test-state-flywheel': values of the type"):
        read(path, voltage="sysid-test-state-flywheel", motor_speed="NT:/drive/turns")


def test_an_entry_that_is_logged_when_it_changes_keeps_its_value(tmp_path):
    path, s = tmp_path / "log.wpilog", made.signals()
    raw = [
        b"WPILOG\x00\x01" + bytes(4),
        made.started(1, "u", "double"),
        made.started(2, "w", "double"),
    ]
    for k, time in enumerate(s.time):
        if k % 100 == 0:
            raw.append(made.record(1, time, np.float64(k / 100).tobytes()))
        raw.append(made.record(2, time, np.float64(s.speed[k]).tobytes()))
    path.write_bytes(b"".join(raw))
    (record,) = read(path, voltage="u", motor_speed="w:rad/s")
    np.testing.assert_array_equal(record.voltage, np.arange(made.ROWS) // 100)


def test_a_data_log_that_was_cut_off_is_read_up_to_its_last_record(tmp_path):
    path = made.wpilog(tmp_path / "log.wpilog", made.signals())
    path.write_bytes(path.read_bytes()[:-3000])
    assert len(read(path)) == 4


def test_tests_in_a_parquet_file(tmp_path):
    pyarrow = pytest.importorskip("pyarrow", reason="Parquet files need the extra parquet")
    from pyarrow import parquet

    s, path = made.signals(), tmp_path / "log.parquet"
    columns = {"t": s.time, "test": ["up"] * 200 + ["none"] * 100 + ["up"] * 100}
    parquet.write_table(pyarrow.table({**columns, "U": s.voltage, "w": s.speed}), path)
    records = read(path)
    assert [r.name for r in records] == ["log.parquet: up", "log.parquet: up #2"]
    assert [len(r.time) for r in records] == [200, 100]


def test_records_of_a_data_log_are_those_of_its_specification():
    """The bytes are the examples of its sections Records and Start."""
    number = made.record(1, 1.0, (3).to_bytes(8, "little"))
    assert number == bytes.fromhex("20 01 08 40 42 0f 03 00 00 00 00 00 00 00")
    start = bytes.fromhex("00 01 00 00 00 04 00 00 00 74 65 73 74 05 00 00 00 69 6e 74 36 34")
    assert made.started(1, "test", "int64")[4:] == start + bytes(4)


def test_a_data_log_of_the_specification_is_read(tmp_path):
    path = tmp_path / "log.wpilog"
    number = made.record(1, 1.0, (3).to_bytes(8, "little"))
    path.write_bytes(b"WPILOG\x00\x01" + bytes(4) + made.started(1, "test", "int64") + number)
    (entry,) = read_wpilog(path).values()
    assert (entry.name, entry.kind, entry.times, entry.values) == ("test", "int64", [1.0], [3.0])
    path.write_bytes(b"WPILOG\x00\x02" + bytes(40))
    with pytest.raises(
        DataError, match=r"log.wpilog: version 2.0 of the format; expected version 1"
    ):
        read_wpilog(path)


def test_an_impossible_clock_of_an_oscilloscope_is_refused(tmp_path):
    path = made.rigol(tmp_path / "scope.csv", made.signals())
    path.write_text(path.read_text().replace("0.02,", "1e308,", 1).replace(",0.02", ",1e308", 1))
    with pytest.raises(DataError, match=r"scope.csv row 2: samples every 1e\+308 s"):
        read(path, voltage="CH1")
