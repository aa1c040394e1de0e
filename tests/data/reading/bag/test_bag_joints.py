"""Joints are found by their names, in messages and topics of any order."""

from __future__ import annotations

import numpy as np
import pytest

from slipid.data.reading.assemble import assembled
from tests.helpers.made_bags import (
    joint_states,
)
from tests.helpers.one_bag import ANGLE, RESOLUTION, TIME, bag, layout, read


def test_joints_are_found_by_name_in_any_order(tmp_path):
    ahead = joint_states("/joint_states", TIME[::2], ["left", "right"], position=ANGLE[::2])
    back = joint_states(
        "/joint_states", TIME[1::2], ["arm", "right", "left"], position=with_arm(ANGLE[1::2])
    )
    topics = {"wheel_angle": {"topic": "/joint_states"}}
    run = read(bag(tmp_path, "mcap", ahead, back), joints=("right", "left"), topics=topics)
    np.testing.assert_allclose(run.signals["wheel_angle"].values, ANGLE[:, ::-1])


def with_arm(angle):
    """Return columns arm, right, left."""
    return np.column_stack([np.full(len(angle), 99.0), angle[:, 1], angle[:, 0]])


def test_messages_of_other_joints_are_left_out(tmp_path):
    wheels = joint_states("/joint_states", TIME, ["left", "right"], position=ANGLE)
    arm = joint_states("/joint_states", TIME + 0.005, ["arm"], position=ANGLE[:, :1])
    topics = {"wheel_angle": {"topic": "/joint_states"}}
    run = read(bag(tmp_path, "sqlite3", wheels, arm), topics=topics)
    np.testing.assert_allclose(run.signals["wheel_angle"].values, ANGLE)
    np.testing.assert_array_equal(
        run.signals["wheel_angle"].source.lines, 1 + 2 * np.arange(len(TIME))
    )


def test_joints_in_messages_of_their_own_are_laid_side_by_side(tmp_path):
    straight = np.column_stack([TIME - TIME[0], 2.0 * (TIME - TIME[0])])
    left = joint_states("/left", TIME, ["left"], position=straight[:, :1])
    later = TIME + 0.003
    right = joint_states("/right", later, ["right"], position=straight[:, 1:] + 0.006)
    topics = {"wheel_angle": {"topic": ["/left", "/right"]}}
    run = read(bag(tmp_path, "mcap", left, right), topics=topics)
    signal = run.signals["wheel_angle"]
    np.testing.assert_allclose(signal.values, straight[1:], atol=1e-6)
    np.testing.assert_allclose(signal.time, TIME[1:], rtol=0, atol=RESOLUTION)
    assert "interpolated" in run.notes[0]
    assert "right" in run.notes[0]


def test_a_message_without_one_of_the_joints_is_left_out_with_a_note(tmp_path):
    messages = joint_states("/joint_states", TIME, ["left", "right"], position=ANGLE)
    messages[7] = joint_states("/joint_states", TIME[7:8], ["left"], position=ANGLE[7:8, :1])[0]
    topics = {"wheel_angle": {"topic": "/joint_states"}}
    run = read(bag(tmp_path, "mcap", messages), topics=topics)
    np.testing.assert_allclose(run.signals["wheel_angle"].values, np.delete(ANGLE, 7, axis=0))
    assert "1 messages without all of left, right" in run.notes[0]


@pytest.mark.parametrize(
    ("channel", "unit", "factor"),
    [
        ("current", "A", 1.0),
        ("motor_torque", "N*m", 1.0),
        ("wheel_torque", "N m", 1.0),
        ("motor_torque", "N*mm", 1e-3),
        ("voltage", "V", 1.0),
        ("duty", "1", 1.0),
        ("duty", "%", 0.01),
    ],
)
def test_what_effort_may_mean(tmp_path, channel, unit, factor):
    messages = joint_states("/joint_states", TIME, ["left", "right"], effort=ANGLE)
    topics = {channel: {"topic": "/joint_states", "field": "effort", "unit": unit}}
    run = read(bag(tmp_path, "mcap", messages), topics=topics, torque_constant=0.05)
    np.testing.assert_allclose(run.signals[channel].values, ANGLE * factor)


@pytest.mark.parametrize(
    ("channel", "constant", "amount"),
    [
        ("wheel_torque", None, 1.0),
        ("motor_torque", None, 16.0),
        ("wheel_torque", 0.05, 1 / (16.0 * 0.05)),
        ("motor_torque", 0.05, 1 / 0.05),
    ],
)
def test_torques_are_currents_where_their_constant_is_known(tmp_path, channel, constant, amount):
    messages = joint_states("/joint_states", TIME, ["left", "right"], position=ANGLE, effort=ANGLE)
    at = {"topic": "/joint_states", "field": "effort"}
    topics = {
        "wheel_angle": {"topic": "/joint_states"},
        channel: at | {"unit": "N*m"},
        "voltage": at | {"unit": "V"},
    }
    more = {} if constant is None else {"torque_constant": constant}
    run = read(bag(tmp_path, "mcap", messages), topics=topics)
    log = assembled(run, layout(topics=topics, gear_ratio=16.0, **more))
    np.testing.assert_allclose(log.current, amount * ANGLE)
    assert log.current_is_torque == (constant is None)
    assert (log.voltage is None) == (constant is None)
