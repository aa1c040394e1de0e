"""Channels of columns, by their names and by the size of their numbers."""

from __future__ import annotations

import numpy as np
import pytest

from slipid.app.new.units import heading_unit, position_unit, time_unit
from slipid.data.reading.column_names import meaning_of, without_unit


@pytest.mark.parametrize(
    ("name", "channel", "label", "unit"),
    [
        ("t", "time", "", ""),
        ("%time", "time", "", ""),
        ("header.stamp", "time", "", ""),
        ("timestamp_ns", "time", "", "ns"),
        ("Time, ms", "time", "", "ms"),
        ("x_mm", "pose_x", "", "mm"),
        ("pose.pose.position.y", "pose_y", "", ""),
        ("yaw [deg]", "pose_heading", "", "deg"),
        ("theta", "pose_heading", "", ""),
        ("heading", "pose_heading", "", ""),
        ("qw", "pose_quaternion", "w", ""),
        ("field.pose.pose.orientation.z", "pose_quaternion", "z", ""),
        ("wl", "wheel_speed", "l", ""),
        ("left_vel", "wheel_speed", "l", ""),
        ("wheel_front_left_vel", "wheel_speed", "fl", ""),
        ("rear_right_wheel_joint_velocity", "wheel_speed", "rr", ""),
        ("left_rpm", "wheel_speed", "l", "rpm"),
        ("motor_2_speed_rpm", "motor_speed", "2", "rpm"),
        ("m1setvel", "motor_speed_command", "1", ""),
        ("m1pos", "motor_position", "1", ""),
        ("enc_r", "wheel_ticks", "r", ""),
        ("i1", "current", "1", ""),
        ("curR", "current", "r", ""),
        ("left_current_mA", "current", "l", "mA"),
        ("u2", "voltage", "2", ""),
        ("vl", "wheel_v", "l", ""),
        ("vbat", "bus_voltage", "", ""),
        ("cmd_v", "twist_command_x", "", ""),
        ("cmd_vel.angular.z", "twist_command_yaw", "", ""),
        ("cmd_vy", "twist_command_y", "", ""),
        ("gyro_z", "gyro", "", ""),
        ("effort[1]", "wheel_torque", "1", ""),
        ("pwm_l", "duty", "l", ""),
        ("w1_angle_rad", "wheel_position", "1", "rad"),
        ("w1", "wheel_speed", "1", ""),
    ],
)
def test_names_as_people_use_them(name, channel, label, unit):
    found = meaning_of(name)
    assert (found.channel, found.label, found.unit, found.doubt) == (channel, label, unit, "")


@pytest.mark.parametrize("name", ["temperature", "accel_std", "dx", "delta_x", "n", "foo", "lux"])
def test_names_of_other_things_say_nothing(name):
    assert meaning_of(name).channel == ""


def test_odometry_is_no_pose():
    assert meaning_of("odom_x").channel == "odometry"


@pytest.mark.parametrize(
    ("name", "channel"),
    [("headng", "pose_heading"), ("lef_vel", "wheel_speed"), ("curent_left", "current")],
)
def test_misspelled_names_are_understood_and_doubted(name, channel):
    found = meaning_of(name)
    assert found.channel == channel
    assert found.doubt.startswith("misspelled? ")


@pytest.mark.parametrize(
    ("name", "bare", "unit"),
    [
        ("v [mm/s]", "v", "mm/s"),
        ("Angle, deg", "Angle", "deg"),
        ("speed_rad_s", "speed", "rad/s"),
        ("a[0]", "a[0]", ""),
    ],
)
def test_units_in_names(name, bare, unit):
    assert without_unit(name) == (bare, unit)


@pytest.mark.parametrize(
    ("values", "unit"),
    [
        (np.arange(100) * 0.02, "s"),
        (np.arange(100) * 20.0, "ms"),
        (np.arange(100) * 20e3, "us"),
        (np.arange(100) * 20e6, "ns"),
        (1.7e9 + np.arange(100) * 0.02, "s"),
        (1.7e12 + np.arange(100) * 20.0, "ms"),
        (1.7e18 + np.arange(100) * 20e6, "ns"),
    ],
)
def test_unit_of_time_from_its_steps_or_since_1970(values, unit):
    found = time_unit(values)
    assert (found.unit, found.doubt) == (unit, "")


def test_steps_that_fit_two_units_are_a_question():
    assert "in s or ms?" in time_unit(np.arange(50) * 2.0).doubt


def test_units_of_a_pose():
    time = np.arange(0, 10, 0.1)
    assert position_unit(time, 0.3 * time, 0 * time).unit == "m"
    assert position_unit(time, 300 * time, 1 + 0.5 * time).unit == "mm"
    assert "pixel" in position_unit(time, np.round(50 * time), np.round(20 * time)).doubt
    turn = np.linspace(0, 14, 300)
    assert heading_unit(np.degrees(turn) % 360).unit == "deg"
    assert heading_unit(turn % (2 * np.pi)).unit == "rad"
    assert heading_unit(np.linspace(0, 0.2, 50)).doubt
