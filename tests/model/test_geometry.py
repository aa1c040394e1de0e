"""Kinematics by theorem: body and wheels are inverses, power is kept, bad wheels are refused."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.model.geometry import Geometry, general, mecanum, omni, skid_steer, steered

ROBOTINO = omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0)
GEOMETRIES = {
    "omni 3": ROBOTINO,
    "omni 3, uneven": omni([40.0, 175.0, 310.0], 0.2, 0.05),
    "omni 4": omni([45.0, 135.0, 225.0, 315.0], 0.2, 0.05),
    "omni 5": omni([0.0, 72.0, 144.0, 216.0, 288.0], 0.3, 0.06),
    "omni 3, rollers at 60 deg": omni([60.0, 180.0, 300.0], 0.125, 0.04, roller_deg=60.0),
    "mecanum": mecanum(0.2, 0.15, 0.05),
}


def twists(count=50):
    return np.random.default_rng(0).normal(size=(count, 3)) * [1.0, 1.0, 5.0]


@pytest.mark.parametrize("name", GEOMETRIES)
def test_body_to_wheels_to_body_is_the_identity(name):
    g = GEOMETRIES[name]
    xi = twists()
    rim = xi @ np.asarray(g.forward()).T
    np.testing.assert_allclose(rim @ np.asarray(g.pseudo_inverse()).T, xi, atol=1e-12)


@pytest.mark.parametrize("name", GEOMETRIES)
def test_wheels_to_body_is_least_squares(name):
    g = GEOMETRIES[name]
    rim = np.random.default_rng(1).normal(size=(20, g.wheels))
    expected = np.linalg.lstsq(np.asarray(g.forward()), rim.T, rcond=None)[0].T
    np.testing.assert_allclose(rim @ np.asarray(g.pseudo_inverse()).T, expected, atol=1e-12)


def test_the_paper_s_two_kinematic_matrices_are_exact_inverses():
    d = np.radians([60.0, 180.0, 300.0])
    base = 0.125
    to_wheels = np.stack([-np.sin(d), np.cos(d), np.full(3, base)], axis=1)
    to_body = np.stack([-2 * np.sin(d), 2 * np.cos(d), np.full(3, 1 / base)]) / 3
    np.testing.assert_allclose(to_wheels @ to_body, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(ROBOTINO.forward(), to_wheels, atol=1e-12)
    np.testing.assert_allclose(ROBOTINO.pseudo_inverse(), to_body, atol=1e-12)


def test_mecanum_has_the_textbook_matrix():
    a, b = 0.2, 0.15
    front_left, front_right = [1.0, -1.0, -(a + b)], [1.0, 1.0, a + b]
    rear_left, rear_right = [1.0, 1.0, -(a + b)], [1.0, -1.0, a + b]
    expected = [front_left, front_right, rear_left, rear_right]
    np.testing.assert_allclose(mecanum(a, b, 0.05).forward(), expected, atol=1e-12)


def test_a_wheel_s_rim_speed_is_that_of_its_centre_along_the_drive():
    """Against the speed of a point of a rigid body, differentiated from its path."""
    g = general([(0.3, 0.1), (-0.2, 0.25), (0.0, -0.3)], [20.0, 140.0, 250.0], [90.0] * 3, 0.05)
    places = np.asarray(g.place) * float(g.base_radius)
    for xi in twists(5):

        def world(t, p, xi=xi):
            c, s = jnp.cos(xi[2] * t), jnp.sin(xi[2] * t)
            return jnp.stack([xi[0] * t + c * p[0] - s * p[1], xi[1] * t + s * p[0] + c * p[1]])

        for k, (p, angle) in enumerate(zip(places, g.drive_angle, strict=True)):
            speed = jax.jacfwd(world)(0.0, jnp.asarray(p))
            along = speed @ jnp.array([np.cos(angle), np.sin(angle)])
            assert float(g.forward()[k] @ xi) == pytest.approx(float(along), abs=1e-12)


@pytest.mark.parametrize("name", GEOMETRIES)
def test_drive_is_split_over_hold_and_roll(name):
    """`hold` and `roll` are perpendicular, and the drive direction splits over both."""
    frame = GEOMETRIES[name].frame()
    hold, roll = np.asarray(frame.hold), np.asarray(frame.roll)
    np.testing.assert_allclose((hold[:, :2] * roll[:, :2]).sum(1), 0.0, atol=1e-14)
    np.testing.assert_allclose(np.hypot(hold[:, 0], hold[:, 1]), 1.0, rtol=1e-14)
    drive = (
        np.asarray(frame.drive_share)[:, None] * hold
        + np.asarray(frame.roller_share)[:, None] * roll
    )
    angle = np.asarray(GEOMETRIES[name].drive_angle)
    np.testing.assert_allclose(
        drive[:, :2], np.stack([np.cos(angle), np.sin(angle)], 1), atol=1e-14
    )


@pytest.mark.parametrize("name", [*GEOMETRIES, "skid steer"])
def test_load_shift_moves_the_centre_of_load_and_keeps_the_weight(name):
    g = {**GEOMETRIES, "skid steer": skid_steer(0.2, 0.15, 0.05)}[name]
    shift = np.asarray(g.frame().shift)
    places = np.asarray(g.place) * float(g.base_radius)
    np.testing.assert_allclose(np.ones(g.wheels) @ shift, 0.0, atol=1e-12)
    np.testing.assert_allclose(places.T @ shift, np.eye(2), atol=1e-12)


def test_drive_offset_turns_one_wheel():
    offset = jnp.array([0.0, 0.02, 0.0])
    turned = Geometry(
        wheel_radius=ROBOTINO.wheel_radius,
        base_radius=ROBOTINO.base_radius,
        drive_offset=offset,
        place=ROBOTINO.place,
        drive_angle=ROBOTINO.drive_angle,
        roller_angle=ROBOTINO.roller_angle,
        grips=ROBOTINO.grips,
        gear_ratio=16.0,
    )
    by_hand = general(
        np.asarray(ROBOTINO.place) * 0.125,
        np.degrees(np.asarray(ROBOTINO.drive_angle) + np.asarray(offset)),
        [90.0] * 3,
        0.04,
    )
    np.testing.assert_allclose(turned.forward(), by_hand.forward(), atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 180.0, 1.0, -179.0])
def test_singular_rollers_are_refused(angle):
    with pytest.raises(ValueError, match=r"wheel 1: rollers at .* deg .* expected 90 \(omni\), 45"):
        omni([0.0, 120.0, 240.0], 0.1, 0.05, roller_deg=angle)


def test_the_singular_wheel_is_named():
    with pytest.raises(ValueError, match="wheel 3: rollers at 180 deg"):
        general(
            [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0)], [90.0, 180.0, 270.0], [90.0, 45.0, 180.0], 0.1
        )


@pytest.mark.parametrize(
    "g",
    [
        skid_steer(0.2, 0.15, 0.05),
        omni([0.0, 180.0], 0.1, 0.05),
        # no wheel has a lever about the centre, so none feels a turn
        general([(0.1, 0.0), (0.0, 0.1), (-0.1, 0.0)], [0.0, 90.0, 180.0], [90.0] * 3, 0.05),
    ],
    ids=["skid steer", "two wheels", "drives through the centre"],
)
def test_rank_below_three_has_the_smallest_twist_that_comes_nearest(g):
    assert not g.determines_twist
    forward, back = np.asarray(g.forward()), np.asarray(g.pseudo_inverse())
    np.testing.assert_allclose(forward @ back @ forward, forward, atol=1e-12)
    np.testing.assert_allclose(back @ forward @ back, back, atol=1e-12)
    assert np.isfinite(np.asarray(g.frame().shift)).all()


def test_wheels_at_one_point_are_refused():
    with pytest.raises(ValueError, match="all wheels are at the origin"):
        general([(0.0, 0.0)] * 3, [0.0, 120.0, 240.0], [90.0] * 3, 0.05)


def test_a_wheel_without_rollers_drives_like_an_omni_wheel_and_grips():
    frame = skid_steer(0.2, 0.15, 0.05).frame()
    np.testing.assert_array_equal(frame.grip, 1.0)
    np.testing.assert_allclose(frame.drive_share, 1.0)
    np.testing.assert_allclose(frame.roller_share, 0.0, atol=1e-15)
    np.testing.assert_allclose(frame.hold[:, :2], [[1.0, 0.0]] * 4, atol=1e-15)


@pytest.mark.parametrize(
    ("made", "axis"),
    [
        (omni([60.0, 180.0, 300.0], 0.125, 0.04), 0.0),
        (omni([30.0, 150.0, 270.0], 0.125, 0.04), np.pi / 2),
        (omni([10.0, 130.0, 250.0], 0.125, 0.04), None),
        (mecanum(0.2, 0.15, 0.05), 0.0),
        (skid_steer(0.2, 0.15, 0.05), 0.0),
    ],
)
def test_the_mirror_of_a_body(made, axis):
    assert made.mirror() == axis
    rough = tuple((round(x, 2), round(y, 2)) for x, y in made.place)
    assert replace(made, place=rough).mirror() == axis
    if axis is not None:  # one wheel that drives another way has no image
        turned = (made.drive_angle[0] + 0.1, *made.drive_angle[1:])
        assert replace(made, drive_angle=turned).mirror() is None


def test_wheels_without_rollers_grip():
    assert steered(0.3, 0.05, 1.0, "rear", 2).grips == (True, True)
    assert skid_steer(0.2, 0.15, 0.05).grips == (True,) * 4
    assert ROBOTINO.grips == (False,) * 3
