"""Hypotheses of the floors under the wheels."""

import itertools

import numpy as np
import pytest

from slipid.model.geometry import general
from slipid.robot.filter.hypotheses import MOST_CHANGES, _hypotheses


def ways(place, floors, changes=MOST_CHANGES, unseen=0):
    """Return the hypotheses of known floors and, after them, unseen ones."""
    around = general(place, [0.0] * len(place), [90.0] * len(place), 0.05).around
    return _hypotheses(around, (False,) * floors + (True,) * unseen, changes)


THREE = [(0.5, 0.9), (-1.0, 0.0), (0.5, -0.9)]
FOUR = [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)]  # not in order around the robot


@pytest.mark.parametrize(
    ("place", "floors", "count"),
    [(THREE, 1, 1), (THREE, 2, 8), (THREE, 3, 21), (FOUR, 2, 14), (FOUR, 5, 125)],
)
def test_an_edge_parts_neighbouring_wheels(place, floors, count):
    found = ways(place, floors)
    assert len(found) == count
    assert len({tuple(row) for row in found.under.tolist()}) == count


def test_every_straight_edge_is_one_of_them_and_no_two():
    found = {tuple(row) for row in ways(FOUR, 2).under.tolist()}
    for angle in np.linspace(0.0, 2 * np.pi, 97):
        side = np.array(FOUR) @ [np.cos(angle), np.sin(angle)]
        for far in np.linspace(-1.5, 1.5, 31):
            assert tuple((side > far).astype(int)) in found
    assert (0, 1, 1, 0) not in found  # wheels across the diagonal alone


def test_neighbours_differ_under_one_wheel():
    found = ways(FOUR, 3)
    for wheel, k, floor in itertools.product(range(4), range(len(found)), range(3)):
        other = found.beside[wheel, k, floor]
        wanted = found.under[k].copy()
        wanted[wheel] = floor
        if other < len(found):
            np.testing.assert_array_equal(found.under[other], wanted)
        else:
            assert not (found.under == wanted).all(axis=1).any()


def test_all_wheels_on_a_floor_and_floors_under_wheels():
    found = ways(THREE, 3)
    np.testing.assert_array_equal(
        found.under[found.uniform], np.repeat(np.arange(3), 3).reshape(3, 3)
    )
    np.testing.assert_array_equal(np.argmax(found.on, axis=2), found.under)
    assert (found.on.sum(axis=2) == 1).all()


def test_all_assignments_are_there_if_edges_may_be_anywhere():
    assert len(ways(FOUR, 5, changes=4)) == 625


def test_a_floor_that_nobody_drove_on_is_under_all_wheels_or_none():
    found = ways(THREE, 2, unseen=3)
    assert len(found) == 8 + 3
    assert found.under[8:].tolist() == [[2] * 3, [3] * 3, [4] * 3]
    assert found.uniform.tolist()[2:] == [8, 9, 10]
    # no wheel alone comes to it or leaves it
    for floor in range(2):
        assert (found.beside[:, 8:, floor] == len(found)).all()
        assert (found.beside[:, :8, 2 + floor] == len(found)).all()
