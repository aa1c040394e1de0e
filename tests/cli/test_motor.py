"""`slipid motor`, drive = "motor", and a bench's numbers as priors of a robot."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from slipid.app.bench import records_of
from slipid.app.bench_priors import bench_priors
from slipid.app.config import parsed
from slipid.data.reading.column_names import meaning_of
from slipid.data.reading.layout import SensorLayout
from slipid.data.reading.motor_layout import MotorOptions, given_columns, motor_layout
from slipid.data.reading.table_format import format_of
from slipid.infer.bench.least_squares import RIVALS
from slipid.support.errors import DataError
from tests.helpers import made_bench as made
from tests.helpers import resting
from tests.helpers.shared import invoke

CONFIG = """
[robot]
drive = "motor"
names = ["left", "right"]
voltage_between_rows = "jumps"
[[logs]]
glob = "*.csv"
format = "mine"
[layouts.mine.columns]
time = { column = "t", unit = "s" }
voltage = { columns = ["U1", "U2"], unit = "V" }
current = { columns = ["I1", "I2"], unit = "A" }
motor_speed = { columns = ["w1", "w2"], unit = "rad/s" }
[parameters]
"motor.brush_drop@left" = { fixed = 0.0 }
"""
ROBOT = """
[robot]
drive = "omni"
base_radius_m = 0.125
wheel_azimuths_deg = [60, 180, 300]
wheel_radius_m = 0.04
gear_ratio = 16
{motor}
[[logs]]
glob = "*.csv"
format = "robotino2022"
"""


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A folder with a log of one motor, and one of two motors with its config."""
    folder = tmp_path_factory.mktemp("bench")
    rows = made.driven(made.FLYWHEEL)
    one, two = made.logged(rows, 100, 3), made.logged(rows, 100, 3, noise=(0.1, 0.02, 2.0))
    made.write(one, folder / "one.csv")
    (folder / "two").mkdir()
    columns = [one.time, one.voltage, one.current, one.speed, two.voltage, two.current, two.speed]
    names = "t,U1,I1,w1,U2,I2,w2"
    path = folder / "two" / "both.csv"
    np.savetxt(path, np.stack(columns, 1), delimiter=",", header=names, comments="", fmt="%.7g")
    (folder / "bench.toml").write_text(CONFIG)
    return folder


@pytest.fixture(scope="module")
def identified(bench):
    result = invoke(
        "identify", bench / "bench.toml", "--data", bench / "two", "--out", bench / "out", "--quiet"
    )
    assert result.exit_code == 0, result.output
    return bench / "out"


@pytest.mark.slow
def test_a_file_without_options(bench):
    result = invoke("motor", bench / "one.csv", "--out", bench / "single", "--quiet")
    assert result.exit_code == 0, result.output
    assert "voltage: U [V]" in result.output
    found = json.loads((bench / "single" / "motor.json").read_text())
    assert found["schema"] == "slipid.identified/1"
    assert found["parameters"]["motor.resistance"]["value"] == pytest.approx(5.5, rel=0.02)
    assert (bench / "single" / "bench.png").stat().st_size > 10_000
    kV = found["feedforward"]["motor"]["kV"]
    assert kV["value"] == pytest.approx(0.0514 + 5.5 * 2e-5 / 0.0514, rel=0.01)
    assert found["feedback"]["motor"]["velocity_kP"]["value"] > 0
    assert repr(kV["value"]) in (bench / "single" / "motor_feedforward.h").read_text()
    assert repr(kV["value"]) in (bench / "single" / "motor_feedforward.yaml").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("form", ["straight", "jumps"])
def test_the_voltage_between_rows_can_be_given(bench, form):
    result = invoke("motor", bench / "one.csv", "--between", form, "--json", "-", "--quiet")
    found = json.loads(result.stdout)
    assert found["drive"] == "motor"
    assert found["motors"]["motor"]["voltage_between_rows"] == form


@pytest.mark.slow
def test_units_and_delimiter(bench, tmp_path):
    made_one = made.logged(made.driven(made.FLYWHEEL), 100, 3)
    table = [
        1e3 * made_one.time,
        made_one.voltage,
        1e3 * made_one.current,
        made_one.speed * 30 / np.pi,
    ]
    path = tmp_path / "log.csv"
    np.savetxt(path, np.stack(table, 1), delimiter=";", header="t_ms;volts;x;y", comments="")
    result = invoke(
        "motor", path, "--current", "x:mA", "--speed", "y:rpm", "--json", "-", "--quiet"
    )
    assert result.exit_code == 0, result.output
    r = json.loads(result.stdout)["parameters"]["motor.resistance"]
    assert r["value"] == pytest.approx(5.5, rel=0.02)


def test_a_missing_column_lists_what_there_is(bench):
    result = invoke("motor", bench / "one.csv", "--current", "J")
    assert result.exit_code == 2
    assert "no column 'J'" in result.output
    assert "t, U, I, w" in result.output


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda r: replace(r, voltage=np.full_like(r.voltage, np.nan)), "no value in any row"),
        (lambda r: replace(r, time=r.time + 50.0 * (r.time > 3)), "clock jumps"),
        (lambda r: replace(r, current=-r.current), "wrong sign"),
    ],
)
def test_broken_logs_are_refused(tmp_path, spoil, said):
    record = made.logged(made.driven(made.FLYWHEEL), 100, 1)
    result = invoke("motor", made.write(spoil(record), tmp_path / "log.csv"), "--quiet")
    assert result.exit_code == 2
    assert said in result.output


@pytest.mark.slow
def test_rows_without_a_voltage_are_left_out(tmp_path):
    record = made.logged(made.driven(made.FLYWHEEL), 100, 3)
    early = record.time < 3
    cut = replace(
        record,
        time=record.time[early],
        voltage=record.voltage[early],
        current=record.current[early],
        speed=record.speed[early],
    )
    hole = replace(record, voltage=np.where(early, record.voltage, np.nan))
    found = []
    for name, one in (("cut", cut), ("hole", hole)):
        path = made.write(one, tmp_path / f"{name}.csv")
        found.append(json.loads(invoke("motor", path, "--json", "-", "--quiet").stdout))
    values = [f["parameters"]["motor.back_emf"]["value"] for f in found]
    assert values[0] == pytest.approx(values[1], rel=1e-9)


@pytest.mark.slow
def test_an_angle_or_a_duty_will_do(tmp_path):
    rows = made.driven(made.FLYWHEEL)
    record = made.logged(rows, 200, 1)
    angle = np.cumsum(rows[:, 3]) * 1e-4
    at = np.interp(record.time, rows[:, 0], angle)
    path, bus = tmp_path / "log.csv", np.full(len(at), 24.0)
    table = [record.time, record.voltage / 24.0 * 100, bus, record.current, at]
    np.savetxt(path, np.stack(table, 1), delimiter=",", header="t,duty_%,bus,I,angle", comments="")
    result = invoke("motor", path, "--json", "-", "--quiet")
    found = json.loads(result.stdout)["parameters"]
    assert found["motor.resistance"]["value"] == pytest.approx(5.5, rel=0.03)
    assert found["motor.back_emf"]["value"] == pytest.approx(0.0514, rel=0.01)


def test_guesses(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(
        "time [ms];motor_current_mA;speed_set;speed (rpm);Vbat;voltage\n" + "1;2;3;4;5;6\n" * 12
    )
    layout = motor_layout(format_of(path), {}, MotorOptions())
    found = {k: (c.columns[0], c.unit) for k, c in layout.channels.items()}
    assert found == {
        "time": ("time [ms]", "ms"),
        "current": ("motor_current_mA", "mA"),
        "motor_speed": ("speed (rpm)", "rpm"),
        "voltage": ("voltage", "V"),
    }
    assert given_columns("a,b:mA", "current").columns == ("a", "b")
    assert given_columns("/motor:current", "current").unit is None


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        # a row of units below the names, of single letters as well
        (["time;voltage;current;speed", "s;V;A;rpm"], ["s", "V", "A", "rpm"]),
        (["a motor", "s,V,mA,deg/s", "t,U,I,w"], ["s", "V", "mA", "deg/s"]),
        (["t_ms,umotor,I (mA),omega_rpm,sample_rate"], ["ms", "V", "mA", "rpm"]),
        (["seconds\tvolts\tampere\tvel\twanted vel"], ["s", "V", "A", "rad/s"]),
    ],
)
def test_units_of_guesses(tmp_path, lines, expected):
    path = tmp_path / "log.csv"
    delimiter = next(d for d in ";,\t" if d in lines[-1])
    row = delimiter.join("12345"[: lines[-1].count(delimiter) + 1])
    path.write_text("\n".join([*lines, *[row] * 12]))
    layout = motor_layout(format_of(path), {}, MotorOptions())
    names = ("time", "voltage", "current", "motor_speed")
    assert [layout.channels[name].unit for name in names] == expected
    assert [len(layout.channels[name].columns) for name in names] == [1, 1, 1, 1]


def test_columns_of_parquet_and_columns_without_names(tmp_path):
    pyarrow = pytest.importorskip("pyarrow", reason="Parquet files need the extra parquet")
    from pyarrow import parquet

    path = tmp_path / "log.parquet"
    rows = [float(k) for k in range(12)]
    parquet.write_table(pyarrow.table(dict.fromkeys(("t_ms", "U", "I_mA", "rpm"), rows)), path)
    layout = motor_layout(format_of(path), {}, MotorOptions())
    assert [c.unit for c in layout.channels.values()] == ["ms", "V", "mA", "rpm"]
    path = tmp_path / "log.csv"
    path.write_text("1,2,3,4\n" * 12)
    with pytest.raises(DataError, match="no names for 4 columns; expected a line of column names"):
        motor_layout(format_of(path), {}, MotorOptions())


VESC = (
    "ms_today;input_voltage;temp_mos_max;temp_motor;current_motor;current_in;d_axis_current;"
    "q_axis_current;erpm;duty_cycle;amp_hours_used;tachometer;encoder_position;fault_code;vesc_id;"
    "d_axis_voltage;q_axis_voltage;"
)


@pytest.fixture
def vesc(tmp_path):
    """A log in the layout of VESC tool."""
    path = tmp_path / "log.csv"
    row = ";".join(str(k + 1.5) for k in range(VESC.count(";"))) + ";"
    path.write_text("\n".join([VESC, *[row] * 12]))
    return path


def test_a_log_of_vesc_tool_is_known_by_its_names(vesc):
    layout = motor_layout(format_of(vesc), {}, MotorOptions(pole_pairs=7.0))
    assert {k: (*c.columns, c.unit, *c.scale) for k, c in layout.channels.items()} == {
        "time": ("ms_today", "ms", 1.0),
        "voltage": ("q_axis_voltage", "V", 1.0),
        "current": ("q_axis_current", "A", 1.0),
        "motor_speed": ("erpm", "rpm", 1 / 7),
    }


def test_an_electrical_speed_needs_the_pole_pairs(vesc):
    for given in ((), ("--speed", "erpm:rpm")):
        result = invoke("motor", vesc, *given, "--quiet")
        assert result.exit_code == 2
        assert "column 'erpm' has the electrical speed" in result.output
        assert "expected --pole-pairs" in result.output


@pytest.mark.parametrize(
    ("name", "channel"),
    [
        ("q_axis_voltage", "voltage"),
        ("voltage_q", "voltage"),
        ("i_q", "current"),
        ("Vd", ""),
        ("d_current", ""),
    ],
)
def test_a_motor_is_read_along_its_axis_q(name, channel):
    meaning = meaning_of(name, of_motor=True)
    assert meaning.channel == channel
    assert bool(meaning.doubt) == bool(channel)


@pytest.mark.slow
def test_a_log_of_sysid_without_a_current_gives_the_gains_of_the_voltage(tmp_path):
    rows = made.driven(made.FLYWHEEL, profile=made.held)
    record = made.logged(rows, 100, 1, at_changes=True)
    turns = record.speed / (2 * np.pi)
    lines = [
        f"{time:.4f},dynamic-forward,{volts:.3f},{0.01 * angle:.4f},{speed:.4f}"
        for time, volts, angle, speed in zip(
            record.time, record.voltage, np.cumsum(turns), turns, strict=True
        )
    ]
    path = tmp_path / "sysid.csv"
    names = "Timestamp (s),Test,Volts (V),Position (rot),Velocity (rot/s)"
    path.write_text("\n".join([names, *lines]))
    result = invoke("motor", path, "--json", "-", "--quiet")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    gains = found["feedforward"]["motor"]
    assert gains["kS"]["value"] == pytest.approx(5.5 * 0.004 / 0.0514, rel=0.03)
    assert gains["kV"]["value"] == pytest.approx(0.0514 + 5.5 * 2e-5 / 0.0514, rel=0.01)
    assert gains["kA"]["value"] == pytest.approx(5.5 * made.FLYWHEEL / 0.0514, rel=0.02)
    assert found["held_out"]["current_rmse_a"] is None
    assert any("log the motor current" in text for text in found["messages"])


def test_speeds_in_turns_are_known_by_the_names_of_sysid(tmp_path):
    path = tmp_path / "sysid.csv"
    rows = [f"{0.02 * k},dynamic-forward,{0.1 * k},{k},{2 * k}" for k in range(12)]
    names = "Timestamp (s),Test,Volts (V),Position (rot),Velocity (rot/s)"
    path.write_text("\n".join([names, *rows]))
    layout = motor_layout(format_of(path), {}, MotorOptions())
    assert layout.channels["motor_speed"].unit == "rot/s"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--gear", "0"), "'--gear'"),
        (("--ignore", "J", "--ignore", "w"), "no column 'J' to ignore"),
        (("--delimiter", "ab"), "--delimiter 'ab': 2 characters; expected one, such as ;"),
        (("--current", "I:foo"), "column 'I': no unit 'foo' of a channel in A; expected one of"),
        (("--ignore", "I", "--ignore", "U"), "no column for the current or voltage"),
        (("--pulses", "w"), "only one of --pulses and --pulses-per-revolution"),
        (("--voltage", "none.csv::CH1:V"), "none.csv: cannot be read"),
        (
            ("--between", "hold"),
            "--between hold: no form of the voltage between rows, did you",
        ),
        (("--between", "hold"), "expected one of held, straight, jumps"),
        (("--between", "held", "--ignore", "U"), "given (held), but there is no voltage"),
        (("--speed", "w:-rad/s", "--voltage", "U:-V"), "the current has the wrong sign"),
    ],
)
def test_options_reach_the_reader(bench, words, message):
    result = invoke("motor", bench / "one.csv", *words, "--quiet")
    assert result.exit_code == 2
    assert message in result.output


@pytest.mark.slow
def test_two_motors_of_a_config(identified):
    found = json.loads((identified / "identified.json").read_text())
    for label in ("left", "right"):
        r = found["parameters"][f"motor.resistance@{label}"]
        assert r["verdict"] == "identified"
        assert r["value"] == pytest.approx(5.5, rel=0.03)
        assert found["motors"][label]["voltage_between_rows"] == "jumps"
        assert found["held_out"][label]["rivals"].keys() == RIVALS.keys()
    assert found["parameters"]["motor.brush_drop@left"]["verdict"] == "fixed"
    assert (identified / "bench_left.png").is_file()


@pytest.mark.slow
def test_check_lists_the_logs_and_their_ranges(bench):
    result = invoke("check", bench / "bench.toml", "--data", bench / "two", "--quiet")
    assert result.exit_code == 0
    assert "both.csv" in result.output
    assert ".resistance@right" in result.output


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ("validate", "OUT", "--data", "."),
        *((name, "OUT") for name in ("trial", "sample", "design")),
        ("export", "OUT", "--out", "x"),
        ("compare", "CONFIG", "--data", ".", "--out", "x"),
        ("selftest", "CONFIG"),
    ],
)
def test_commands_that_need_wheels_refuse_a_bench(identified, bench, words):
    where = {"OUT": identified, "CONFIG": bench / "bench.toml"}
    result = invoke(*(where.get(word, word) for word in words))
    assert result.exit_code == 2
    assert f"`slipid {words[0]}` is not made" in result.output


@pytest.mark.slow
def test_a_bench_gives_a_robot_its_priors(identified):
    key = 'motor = "out/identified.json"'
    config = parsed(identified.parent / "robot.toml", ROBOT.format(motor=key))
    choices, lines = bench_priors(config, 16.0)
    priors = {c.pattern: c for c in choices}
    assert priors["motor.back_emf"].prior_mean == pytest.approx(0.0514, rel=0.01)
    assert priors["motor.coulomb_friction"].prior_mean == pytest.approx(16 * 0.004, rel=0.1)
    assert priors["motor.viscous_friction"].prior_mean == pytest.approx(256 * 2e-5, rel=0.2)
    assert "motor.rotor_inertia" not in priors
    assert any("motor from" in line for line in lines)


def test_a_wrong_form_of_the_voltage_in_a_config_is_refused_with_the_choices(tmp_path):
    text = CONFIG.replace('"jumps"', '"hold"')
    with pytest.raises(DataError, match=r"robot.*voltage_between_rows.*held.*straight.*jumps"):
        parsed(tmp_path / "bench.toml", text)


def test_a_bench_that_is_none_is_refused(tmp_path):
    config = parsed(tmp_path / "robot.toml", ROBOT.format(motor='motor = "b.json"'))
    with pytest.raises(DataError, match=r"b.json: No such file"):
        bench_priors(config, 16.0)
    (tmp_path / "b.json").write_text('{"schema": "slipid.identified/1", "parameters": {}}')
    with pytest.raises(DataError, match="the parameters of a robot"):
        bench_priors(config, 16.0)


def test_a_missing_bench_file_is_reported_before_logs_are_read(tmp_path):
    (tmp_path / "robot.toml").write_text(ROBOT.format(motor='motor = "b.json"'))
    result = invoke("check", str(tmp_path / "robot.toml"), "--data", str(tmp_path))
    assert result.exit_code == 2
    assert "b.json: No such file" in result.output


@pytest.mark.slow
def test_real_logs_without_voltage(real_data):
    path = real_data / "robotino2021" / "motor_identification.csv"
    speeds = ",".join(f"motor{k}_output" for k in (1, 2, 3))
    result = invoke("motor", path, "--speed", speeds, "--unsigned", "--json", "-", "--quiet")
    found = json.loads(result.stdout)
    assert result.exit_code in (0, 1)
    for label in "123":
        assert found["parameters"][f"motor.resistance@{label}"]["verdict"] == "not_identified"
        assert found["parameters"][f"motor.back_emf@{label}"]["verdict"] == "not_identified"
    assert any("log the motor voltage" in text for text in found["messages"])


def test_a_torque_is_no_current_of_a_motor_on_a_bench():
    log = replace(resting.runs().logs[0], current_is_torque=True)
    with pytest.raises(DataError, match=r"run00.csv: a torque in place of the current"):
        records_of(log, SensorLayout())


def test_magnitudes_of_a_current_are_kept_where_the_shaft_rests():
    log = resting.runs().logs[0]
    still = np.zeros_like(log.wheel_angle)
    log = replace(log, wheel_speed=still, current_is_signed=False)
    record, *_ = records_of(log, SensorLayout())
    assert np.abs(log.current[:, 0]).max() > 0
    np.testing.assert_array_equal(record.current, np.abs(log.current[:, 0]))
