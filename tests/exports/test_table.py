"""gains.md and gains.csv: every number of the robot, to the last bit, with how sure it is."""

from __future__ import annotations

import csv
import io
from dataclasses import fields, replace

import numpy as np
import pytest

from slipid.exports.description import HEAD, gains_origin, table_files
from slipid.robot.deployed import DeployedRobot
from slipid.robot.gains import Gains, used_gains
from slipid.robot.limits import Limits
from slipid.robot.record import ActuatorRecord, LimitsRecord, Setting
from slipid.robot.robot_file import declared_numbers
from tests.helpers.exported import doubtful, mecanum_robot


def table(robot: DeployedRobot) -> list[dict[str, str]]:
    """Rows of gains.csv, by columns."""
    rows = list(csv.reader(io.StringIO(table_files(robot)["gains.csv"])))
    assert rows[0][0].startswith("# Made by slipid")
    plain = [row for row in rows if not row[0].startswith("#")]
    assert tuple(plain[0]) == HEAD
    assert {len(row) for row in plain} == {len(HEAD)}
    return [dict(zip(HEAD, row, strict=True)) for row in plain[1:]]


def values(rows: list[dict[str, str]], group: str) -> list[float]:
    return [float(row["value"]) for row in rows if row["group"] == group]


@pytest.mark.slow
@pytest.mark.parametrize("made", [doubtful, mecanum_robot])
def test_every_number_reads_back_to_the_last_bit(made):
    robot = made()
    rows = table(robot)
    assert values(rows, "forward") == np.ravel(robot.forward).tolist()
    assert values(rows, "inverse") == np.ravel(robot.inverse).tolist()
    assert values(rows, "wheel_curve") == np.ravel(robot.wheel_curve).tolist()
    gains, limits = Gains.of(robot), Limits()
    assert values(rows, "gains") == [float(e.get(gains)) for e in used_gains(robot)]
    assert values(rows, "limits") == list(vars(limits).values())
    assert values(rows, "motor")[0] == robot.record.wheels.gear_ratio
    for e in declared_numbers(robot.record):
        number = robot.record.parameters[e.path]
        found = [row for row in rows if row["name"] == e.path]
        assert [float(row["value"]) for row in found] == np.ravel(number.value).tolist()
        ends = [(row["low90"], row["high90"]) for row in found]
        if number.interval90 is None:
            assert set(ends) == {("", "")}
        else:
            np.testing.assert_array_equal(
                np.asarray(ends, float), np.reshape(number.interval90, (-1, 2))
            )


def test_every_limit_and_noise_says_where_it_comes_from(robot):
    record = robot.record
    mixed = replace(
        record,
        limits=replace(record.limits, voltage=Setting(48.0, "logs"), speed=Setting(0.9)),
        actuators=ActuatorRecord(delay_s=Setting(0.1, "config")),
    )
    made = DeployedRobot.of(mixed, robot.load_setup)
    rows = {row["name"]: row for row in table(made)}
    sure = {name: (row["verdict"], row["provenance"]) for name, row in rows.items()}
    assert sure["limits.yaw_rate"] == ("given", "config")
    assert sure["limits.voltage"] == ("measured", "logs of the fitted runs")
    assert sure["limits.speed"][0] == sure["sensors.gyro_std"][0] == "ASSUMED"
    assert (rows["limits.voltage"]["unit"], rows["sensors.gyro_std"]["unit"]) == ("V", "rad/s")
    assert float(rows["actuators.delay_s"]["value"]) == 0.1
    assert "actuators.lag_s" not in rows
    said = gains_origin(made)
    assert "From the logs: limits.voltage. ASSUMED: limits.speed, sensors.ammeter_std_a" in said
    assert "yaw_rate, limits.acceleration, limits.wheel_speed, actuators.delay_s. From" in said
    given = {f.name: Setting(1.0, "config") for f in fields(mixed.limits)}
    parts = vars(record.sensors).items()
    noise = {name: Setting(1.0, "logs") for name, one in parts if isinstance(one, Setting)}
    known = replace(mixed, limits=LimitsRecord(**given), sensors=replace(record.sensors, **noise))
    assert "ASSUMED" not in gains_origin(DeployedRobot.of(known, robot.load_setup))


def test_names_are_those_of_the_robot_and_stand_once(robot):
    rows = table(robot)
    names = [(row["name"], row["entry"]) for row in rows]
    assert len(set(names)) == len(names)
    assert {e.path for e in declared_numbers(robot.record)} < {name for name, _ in names}


def test_rows_of_a_matrix_say_which_wheel_and_part_of_the_twist(robot):
    by_name = {(row["name"], row["entry"]): float(row["value"]) for row in table(robot)}
    assert by_name["forward[2]", "vy"] == float(robot.forward[1, 1])
    assert by_name["inverse[W]", "wheel 3"] == float(robot.inverse[2, 2])


@pytest.mark.slow
def test_verdicts_warn(robot):
    sure = {row["name"]: row["verdict"] for row in table(robot)}
    assert sure["motor.resistance"] == "NOT IDENTIFIED"
    assert sure["motor.back_emf"] == "AT BOUND"
    assert sure["robot.load_share@moved"] == "DISPUTED"
    assert sure["robot.mass"] == "weak"
    text = table_files(robot)["gains.md"]
    assert "> **WARNING.** NOT IDENTIFIED" in text
    line = next(x for x in text.splitlines() if x.startswith("| `motor.resistance` |"))
    assert "**NOT IDENTIFIED**" in line
    assert "WARNING" not in table_files(mecanum_robot())["gains.md"]


def test_gains_are_those_the_controller_takes(robot):
    late = ActuatorRecord(Setting(0.1, "logs"), Setting(0.03, "logs"))
    known = DeployedRobot.of(replace(robot.record, actuators=late), robot.load_setup)
    by_hand, designed = table(robot), table(known)
    assert by_hand[0]["verdict"] == "by hand"
    assert designed[0]["verdict"] == "designed"
    assert values(designed, "gains")[0] == float(Gains.of(known).place) != Gains().place
    assert "a phase margin of 60 deg" in table_files(known)["gains.md"]


def test_tables_for_reading_hold_whatever_a_name_is(robot):
    text = table_files(robot)["gains.md"]
    columns = {
        len(line.replace("\\|", "").split("|")) for line in text.splitlines() if line[:1] == "|"
    }
    assert columns == {12}
    assert "\x07" not in text
    for row in table(robot):
        assert f" {float(row['value'])!r} |" in text, row
