"""Paths: rates and poses agree, they close, keep limits, and wait for a robot that lags."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

from slipid.robot import trajectory
from slipid.robot.trajectory import SHAPES, PathSection, Turn, tangent


def test_the_rectangle_is_that_of_the_paper_and_stops_at_its_corners():
    path = trajectory.rectangle()
    rows = np.asarray(path.rows)
    length = np.hypot(*np.diff(rows[:, :2], axis=0).T).sum()
    assert length == pytest.approx(2 * (0.9 + 0.4), abs=1e-3)
    corners = np.asarray([np.asarray(path.at(t)) for t in np.asarray(path.marks)])
    np.testing.assert_allclose(
        corners[:, :2], [[0.9, 0], [0.9, -0.4], [0, -0.4], [0, 0]], atol=1e-9
    )
    np.testing.assert_allclose(corners[:, 3:], 0.0, atol=1e-9)
    # rates are the derivatives of places
    np.testing.assert_allclose(
        np.gradient(rows[:, :2], trajectory.ROW_PERIOD, axis=0)[5:-5], rows[5:-5, 3:5], atol=0.011
    )
    assert np.hypot(rows[:, 3], rows[:, 4]).max() <= 0.2 + 1e-9


def test_a_path_too_short_for_its_speed_is_half_acceleration_and_half_braking():
    path = trajectory.waypoints([(0.0, 0.0), (0.02, 0.0)], speed=0.5, acceleration=0.5, pause=0.1)
    place, rate = np.asarray(path.rows)[:, [0, 3]].T
    assert rate.max() == pytest.approx(0.1, rel=1e-6)  # the root of 0.02 * 0.5
    assert np.abs(np.diff(rate)).max() <= 0.5 * trajectory.ROW_PERIOD + 1e-12
    np.testing.assert_allclose(np.diff(place)[:-1], (rate[:-1] + rate[1:])[:-1] * 0.01, atol=1e-9)
    np.testing.assert_allclose([place[-1], rate[-1]], [0.02, 0.0], atol=1e-12)


@pytest.mark.parametrize("name", trajectory.PATHS)
@pytest.mark.parametrize("speed", [0.1, 0.2])
def test_paths_have_the_rates_of_their_places_and_rest_where_they_began(name, speed):
    path = trajectory.PATHS[name](speed)
    rows = np.asarray(path.rows)
    rates = np.gradient(rows[:, :3], trajectory.ROW_PERIOD, axis=0)
    np.testing.assert_allclose(rates[5:-5], rows[5:-5, 3:], atol=0.02)
    pace = np.hypot(rows[:, 3], rows[:, 4])
    assert pace.max() == pytest.approx(speed, rel=1e-4)
    np.testing.assert_allclose(rows[[0, -1], :2], 0.0, atol=1e-9)
    np.testing.assert_allclose(rows[[0, -1], 3:], 0.0, atol=1e-9)
    assert rows[-1, 2] % (2 * np.pi) == pytest.approx(0.0, abs=1e-9)
    at = np.stack([np.asarray(path.at(t)) for t in np.asarray(path.marks)])
    np.testing.assert_allclose(at[:, :2], path.corners, atol=1e-6)


def test_a_circle_is_round_an_eight_goes_both_ways_round_and_one_path_turns():
    path = trajectory.PATHS["circle"](0.2)
    circle = np.asarray(path.rows)[:, :2]
    np.testing.assert_allclose(np.hypot(circle[:, 0], circle[:, 1] + 0.35), 0.35, atol=1e-4)
    np.testing.assert_allclose(
        path.corners,
        [[0.35, -0.35], [0, -0.7], [-0.35, -0.35], [0, 0]],
        atol=4e-3,
    )
    eight = np.asarray(trajectory.PATHS["eight"](0.2).rows)[:, :2]
    side = np.sign(eight[:, 1].round(6))
    np.testing.assert_allclose(
        np.hypot(eight[:, 0], eight[:, 1] - 0.25 * side)[side != 0], 0.25, atol=1e-4
    )
    changes = side[side != 0]
    assert (changes[0], changes[-1], np.count_nonzero(np.diff(changes))) == (-1, 1, 1)
    turning = trajectory.PATHS["turning"](0.2)
    headings = [float(turning.at(t)[2]) for t in np.asarray(turning.marks)]
    np.testing.assert_allclose(headings, -0.5 * np.pi * np.arange(1, 5), atol=1e-9)
    still = np.asarray(trajectory.rectangle().rows)[:, :2]
    np.testing.assert_allclose(np.asarray(turning.rows)[:, :2], still, atol=1e-12)


def test_the_remaining_length_of_a_path_ends_with_it():
    path = trajectory.rectangle()
    left = [float(path.remaining(t)) for t in (0.0, *np.asarray(path.marks), 99.0)]
    np.testing.assert_allclose(left, [2.6, 1.7, 1.3, 0.4, 0.0, 0.0], atol=1e-6)


def test_a_path_moved_to_a_start_has_its_shape():
    start = (0.3, -0.2, 2.0)
    path = trajectory.rectangle()
    moved = path.moved(start)
    c, s = np.cos(2.0), np.sin(2.0)
    back = (np.asarray(moved.rows)[:, :2] - start[:2]) @ np.array([[c, -s], [s, c]])
    np.testing.assert_allclose(back, np.asarray(path.rows)[:, :2], atol=1e-12)
    assert np.asarray(moved.rows)[0, 2] == pytest.approx(2.0)


def test_a_path_waits_for_a_robot_that_lags_and_not_for_one_that_is_ahead():
    path = trajectory.waypoints([(0.0, 0.0), (1.0, 0.0)], pause=0.0)
    now = jnp.asarray(2.0)
    here = np.asarray(path.at(2.0))
    on, rates = path.follow(now, jnp.asarray(here[:3]), 0.05)
    assert float(on) == pytest.approx(2.05)
    assert float(rates[3]) == pytest.approx(0.2)
    far_behind = here[:3] - [0.2, 0.0, 0.0]
    stays, rates = path.follow(now, jnp.asarray(far_behind), 0.05)
    assert float(stays) == pytest.approx(2.0)
    np.testing.assert_allclose(rates[3:], 0.0)
    ahead, _ = path.follow(now, jnp.asarray(here[:3] + np.array([0.2, 0.0, 0.0])), 0.05)
    assert float(ahead) == pytest.approx(2.05)


def test_a_path_waits_for_a_heading_that_lags_and_not_for_one_that_is_ahead():
    path = tangent([Turn(-3.0), PathSection(1.0)], pause=0.0)
    now = jnp.asarray(1.0)  # it turns to the right
    here = np.asarray(path.at(1.0))[:3]

    def waited(turn, arm=0.2, time=now, x=0.0):
        at = np.asarray(path.at(time))[:3] + np.array([x, 0.0, turn])
        later, reference = path.follow(time, jnp.asarray(at), 0.05, 0.0, arm)
        rate = float(later - time) / 0.05
        np.testing.assert_allclose(reference[3:], path.at(later)[3:] * rate, atol=1e-12)
        return 1.0 - rate

    assert here[2] < 0
    assert waited(0.35) == pytest.approx(0.5, abs=1e-3)  # 70 mm at the end of the arm
    for turns in (-2 * np.pi, 4 * np.pi):
        assert waited(0.35 + turns) == pytest.approx(0.5, abs=1e-3)
    assert waited(0.7) == pytest.approx(1.0)
    assert waited(-0.7) == pytest.approx(0.0)  # it is ahead
    assert waited(0.21, x=0.056) == pytest.approx(0.5, abs=1e-3)  # 42 and 56 mm
    ahead = jnp.asarray(path.duration - 2.0)  # it drives straight ahead, either side counts
    assert waited(0.35, time=ahead) == pytest.approx(0.5, abs=1e-3)
    assert waited(-0.35, time=ahead) == pytest.approx(0.5, abs=1e-3)
    for turn in (-2.0, 0.35, 0.7):
        assert waited(turn, arm=0.0) == pytest.approx(0.0)


def test_a_path_waits_for_a_lag_and_not_for_a_tolerated_distance_to_the_side():
    path = tangent([PathSection(1.0)], pause=0.0)
    now = jnp.asarray(2.0)
    here = np.asarray(path.at(now))[:3]

    def waited(x, y):
        later, _ = path.follow(now, jnp.asarray(here) + jnp.array([x, y, 0.0]), 0.05, 0.0, 0.2, 0.1)
        return 1.0 - float(later - now) / 0.05

    assert waited(0.0, 0.1) == waited(0.0, -0.09) == pytest.approx(0.0)
    assert waited(0.0, 0.17) == pytest.approx(0.5, abs=1e-3)
    assert waited(-0.07, 0.1) == pytest.approx(0.5, abs=1e-3)
    assert waited(0.2, 0.0) == pytest.approx(0.0)  # ahead


def test_a_preview_is_of_the_rates_alone():
    path = trajectory.waypoints([(0.0, 0.0), (1.0, 0.0)], pause=0.0)
    now = jnp.asarray(path.duration - 0.35)  # it brakes for 0.4 s
    _, plain = path.follow(now, path.at(now)[:3], 0.05)
    _, early = path.follow(now, path.at(now)[:3], 0.05, 0.2)
    np.testing.assert_array_equal(early[:3], plain[:3])
    assert float(plain[3] - early[3]) == pytest.approx(0.5 * 0.2)


def test_paths_are_refused_with_the_reason():
    with pytest.raises(ValueError, match="at least two points"):
        trajectory.waypoints([(0.0, 0.0)])
    with pytest.raises(ValueError, match="expected positive numbers"):
        trajectory.rectangle(speed=-0.2)
    with pytest.raises(ValueError, match="expected positive numbers"):
        tangent([PathSection(1.0)], speed=0.0)
    with pytest.raises(ValueError, match=r"yaw rate -1.0 rad/s; expected a positive number"):
        tangent([Turn(1.0)], yaw_rate=-1.0)
    with pytest.raises(ValueError, match=r"0\.9 x 0\.4 m; expected a radius below 0\.2 m"):
        trajectory.rectangle_shape(radius=0.2)
    for shape in ([], [PathSection(1.0), Turn(0.0)]):
        with pytest.raises(ValueError, match="expected one or more, each longer than 0"):
            tangent(shape)
    with pytest.raises(ValueError, match="twice in succession"):
        trajectory.waypoints([(0.0, 0.0), (0.0, 0.0)])


CLOSED = {
    **{name: shape(1.0) for name, shape in SHAPES.items()},
    "twice as large": SHAPES["eight"](2.0),
    "with arcs": trajectory.rectangle_shape(radius=0.15),
    "in reverse": [PathSection(0.5, 0.0, 2.0), PathSection(-0.5, 2.0, 0.0)],
    "on the spot": [Turn(1.5), Turn(-3.0), Turn(1.5)],
}
"""Shapes that end where they begin."""


def slopes(rows):
    """Derivatives of the poses in the middle of two rows, and mean rates of the two rows."""
    return np.diff(rows[:, :3], axis=0) / trajectory.ROW_PERIOD, 0.5 * (rows[1:] + rows[:-1])[:, 3:]


@pytest.mark.parametrize("name", CLOSED)
def test_a_tangent_path_has_the_heading_of_its_motion_and_closes(name):
    path = tangent(CLOSED[name])
    rows = np.asarray(path.rows)
    across = rows[:, 4] * np.cos(rows[:, 2]) - rows[:, 3] * np.sin(rows[:, 2])
    np.testing.assert_allclose(across, 0.0, atol=1e-12)
    np.testing.assert_allclose(rows[-1, :2], 0.0, atol=1e-9)
    assert abs(np.exp(1j * rows[-1, 2]) - 1) < 1e-9
    # where a curvature jumps, or a ramp ends, the mean of two rates is off by half the jump
    moved, rates = slopes(rows)
    off = np.abs(moved - rates)
    assert np.quantile(off, 0.95, axis=0).max() < 2e-4
    assert off[:, :2].max() < 0.5 * 0.5 * trajectory.ROW_PERIOD + 1e-6
    gone = trajectory.ROW_PERIOD * rates.sum(axis=0)
    np.testing.assert_allclose(rows[-1, :2], gone[:2], atol=1e-3)
    assert rows[-1, 2] == pytest.approx(gone[2], abs=0.02)


def test_a_turn_does_not_wait_for_a_robot_that_it_moves_further_aside():
    """The floor under a skid steer decides how far a turn moves its middle."""
    path, time = tangent([Turn(-3.0)], centre=0.04), jnp.asarray(1.0)
    here = path.at(time)
    aside = here[3:5] / jnp.sqrt(here[3:5] @ here[3:5])
    pose = here[:3].at[:2].add(-0.12 * aside)
    after, _ = path.follow(time, pose, 0.05, arm=0.2, sideways=0.13)
    assert float(after) == pytest.approx(1.05)
    after, _ = path.follow(time, pose, 0.05, arm=0.2)
    assert float(after) < 1.01


@pytest.mark.parametrize("name", CLOSED)
def test_the_centre_of_rotation_follows_the_shape_and_the_middle_goes_with_it(name):
    centre, plain = -0.06, np.asarray(tangent(CLOSED[name]).rows)
    rows = np.asarray(tangent(CLOSED[name], centre=centre).rows)
    ahead = np.stack([np.cos(rows[:, 2]), np.sin(rows[:, 2])], axis=1)
    np.testing.assert_allclose(rows[:, :2] + centre * (ahead - [1, 0]), plain[:, :2], atol=1e-12)
    moved, rates = slopes(rows)
    assert np.quantile(np.abs(moved - rates), 0.95, axis=0).max() < 2e-3
    across = rows[:, 4] * ahead[:, 0] - rows[:, 3] * ahead[:, 1]
    np.testing.assert_allclose(across, -centre * rows[:, 5], atol=1e-12)


@pytest.mark.parametrize("name", CLOSED)
@pytest.mark.parametrize("yaw_rate", [0.5, 2.0])
def test_a_tangent_path_keeps_its_limits_and_uses_them(name, yaw_rate):
    rows = np.asarray(tangent(CLOSED[name], 0.3, 0.6, yaw_rate=yaw_rate).rows)
    pace = np.hypot(rows[:, 3], rows[:, 4])
    step = trajectory.ROW_PERIOD
    assert pace.max() <= 0.3 + 1e-12
    assert np.abs(rows[:, 5]).max() <= yaw_rate + 1e-12
    assert np.abs(np.diff(pace)).max() <= 0.6 * step + 1e-12
    on_spot = pace < 1e-12
    both = on_spot[1:] & on_spot[:-1]
    assert np.abs(np.diff(rows[:, 5]))[both].max() <= yaw_rate * 0.6 / 0.3 * step + 1e-12
    used = pace.max() / 0.3, np.abs(rows[:, 5]).max() / yaw_rate
    assert max(used) > 0.85  # a clothoid that ends in reverse is slow where it bends most


def test_a_clothoid_has_a_curvature_that_grows_with_the_distance():
    length, bend = 0.8, 2.5
    rows = np.asarray(tangent([PathSection(length, 0.0, bend)]).rows)
    driven = np.append(0.0, np.cumsum(np.hypot(*np.diff(rows[:, :2], axis=0).T)))
    np.testing.assert_allclose(rows[:, 2], 0.5 * bend / length * driven**2, atol=1e-5)
    sine, cosine = special.fresnel(np.sqrt(bend * length / np.pi))
    end = np.sqrt(np.pi * length / bend) * np.array([cosine, sine])
    np.testing.assert_allclose(rows[-1, :2], end, atol=1e-12)
