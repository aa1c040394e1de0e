"""Bad frames are flagged and not interpolated; good ones are not flagged."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from slipid.camera.tracking.track import Flag, jumps
from tests.helpers.made_drives import round_trip, starts_and_stops
from tests.helpers.made_videos import Body
from tests.helpers.tracked import STAGE, errors, tracked

pytestmark = pytest.mark.slow

COUNT = 100
BAD = (11, 22, 34, 57, 80)
AT = 45


@cache
def stop_and_go() -> tuple[np.ndarray, ...]:
    """Return frames of starts and stops of 1 m/s^2 and 90 deg/s; none of these may be flagged."""
    return tuple(STAGE.film([Body(starts_and_stops)], COUNT))


def beside(frame: int, shift=(0.3, 0.25, 1.0), both: bool = False) -> np.ndarray:
    """Return a frame with the robot elsewhere, or with another one there as well."""
    other = Body(lambda t: starts_and_stops(t) + np.array(shift))
    return STAGE.frame(frame / 30, [Body(starts_and_stops), other] if both else [other])


def broken(kind: str) -> dict[int, np.ndarray]:
    good, rng = stop_and_go(), np.random.default_rng(1)
    if kind == "black":
        return {k: np.zeros_like(good[k]) for k in BAD}
    if kind == "noise":
        return {k: rng.integers(0, 255, good[k].shape).astype(np.uint8) for k in BAD}
    if kind == "torn":
        return {k: np.roll(good[k], 60, axis=1) for k in BAD}
    if kind == "out of order":
        return {k: good[(k + 40) % COUNT] for k in BAD}
    if kind == "covered":
        return {k: STAGE.frame(k / 30, []) for k in range(AT, AT + 5)}
    if kind == "reflection in one":
        return {k: beside(k) for k in BAD}
    if kind == "small reflection in one":
        return {k: beside(k, (0.03, 0.0, 0.0)) for k in BAD}
    if kind == "turned in one":
        return {k: beside(k, (0.0, 0.0, 0.4)) for k in BAD}
    assert kind == "reflection in ten"
    return {k: beside(k) for k in range(AT, AT + 10)}


EXPECTED = {
    "black": {Flag.MISSING},
    "noise": {Flag.MISSING},
    "torn": {Flag.JUMP, Flag.SHAPE, Flag.MISSING},
    "out of order": {Flag.JUMP},
    "covered": {Flag.MISSING},
    "reflection in one": {Flag.JUMP},
    "small reflection in one": {Flag.JUMP},
    "turned in one": {Flag.JUMP},
    "reflection in ten": {Flag.JUMP},
}


@pytest.mark.parametrize("kind", EXPECTED)
def test_bad_frames_are_flagged_and_good_ones_are_not(kind, tmp_path):
    bad = broken(kind)
    pictures = [bad.get(k, picture) for k, picture in enumerate(stop_and_go())]
    (track,) = tracked(STAGE, pictures, tmp_path)
    assert np.flatnonzero(~track.good).tolist() == sorted(bad)
    assert {Flag(flag) for flag in track.flag[sorted(bad)]} <= EXPECTED[kind]
    assert np.isnan(track.pose[sorted(bad)]).all()
    assert np.isnan(track.covariance[sorted(bad)]).all()
    kept = np.isfinite(track.rejected[sorted(bad)]).all(axis=1)
    assert kept.tolist() == [Flag(f) in (Flag.JUMP, Flag.SHAPE) for f in track.flag[sorted(bad)]]
    off = errors(track, Body(starts_and_stops))
    assert np.nanmax(np.abs(off[:, :2])) < 1e-3
    assert np.degrees(np.nanmax(np.abs(off[:, 2]))) < 0.6


def test_frozen_frames_are_flagged(tmp_path):
    pictures = list(stop_and_go()[:40])
    for k in (10, 11, 12, 30):
        pictures[k] = pictures[k - 1].copy()
    (track,) = tracked(STAGE, pictures, tmp_path)
    assert np.flatnonzero(~track.good).tolist() == [10, 11, 12, 30]
    assert (track.flag[[10, 11, 12, 30]] == Flag.REPEATED).all()


def test_a_second_marker_of_the_number_never_leads_astray(tmp_path):
    """It is noticed at the next search of a whole frame; until then the right one is followed."""
    pictures = list(stop_and_go()[:90])
    for k in range(20, 80):
        pictures[k] = beside(k, (0.3, 0.2, 1.0), both=True)
    (track,) = tracked(STAGE, pictures, tmp_path)
    assert np.nanmax(np.abs(errors(track, Body(starts_and_stops))[:, :2])) < 1e-3
    assert (track.flag[30:80] == Flag.AMBIGUOUS).all()
    assert track.good[:30].all()
    assert track.good[80:].all()
    assert "detected twice" in " ".join(track.doubts())


@pytest.mark.parametrize("noise", [1.0, 0.05])
def test_no_false_alarms_in_a_minute_of_sharp_driving(noise):
    """Corners are drawn with noise, not pictures: starts, stops and turns, at 10 to 60 frames/s."""
    rng = np.random.default_rng(0)
    for fps in (10.0, 30.0, 60.0):
        time = np.arange(int(60 * fps)) / fps
        std = noise * np.broadcast_to([1e-3, 1e-3, 4e-3], (len(time), 3))
        pose = np.array([starts_and_stops(t) for t in time]) + std * rng.normal(size=std.shape)
        pose[:, 2] = np.angle(np.exp(1j * pose[:, 2]))
        pose[rng.random(len(time)) < 0.05] = np.nan
        assert not jumps(time, pose, std).any()


@pytest.mark.parametrize("fps", [5.0, 10.0, 30.0])
def test_hard_braking_is_accepted(fps):
    """2.5 m/s^2 from 1 m/s on, almost without noise."""
    time = np.arange(int(4 * fps)) / fps
    braking = np.clip(time - 2.0, 0.0, 0.4)
    path = np.minimum(time, 2.0) + braking - 1.25 * braking**2
    pose = np.column_stack([path, 0.1 * path, np.zeros(len(time))])
    assert not jumps(time, pose, np.full(pose.shape, 1e-5)).any()


def test_many_wrong_poses_among_good_ones():
    """A fifth of the poses is wrong by 0.1 to 0.6 m: exactly those are rejected."""
    rng = np.random.default_rng(4)
    time = np.arange(900) / 30
    std = np.broadcast_to([5e-4, 5e-4, 2e-3], (len(time), 3))
    pose = np.array([starts_and_stops(t) for t in time]) + std * rng.normal(size=std.shape)
    wrong = rng.random(len(time)) < 0.2
    aside = rng.choice([-1.0, 1.0], (wrong.sum(), 3))
    pose[wrong] += aside * rng.uniform(0.1, 0.6, aside.shape)
    assert np.array_equal(jumps(time, pose, std), wrong)


def test_a_long_mistake_is_rejected_as_a_whole():
    time = np.arange(300) / 30
    std = np.broadcast_to([5e-4, 5e-4, 2e-3], (len(time), 3))
    pose = np.array([round_trip()(t) for t in time])
    for first, last in ((0, 30), (100, 180), (290, 300)):
        moved = pose.copy()
        moved[first:last, :2] += (0.4, -0.3)
        assert np.flatnonzero(jumps(time, moved, std)).tolist() == list(range(first, last))


def test_a_small_mistake_is_rejected():
    """40 frames lie 6 cm aside; where they end one good frame may be rejected with them."""
    time = np.arange(240) / 30
    std = np.broadcast_to([4e-4, 4e-4, 3e-3], (len(time), 3))
    pose = np.array([starts_and_stops(t) for t in time])
    pose[100:140, 0] += 0.06
    rejected = set(np.flatnonzero(jumps(time, pose, std)).tolist())
    assert rejected >= set(range(100, 140))
    assert len(rejected) <= 41


def test_few_poses_are_left_alone():
    time = np.arange(4.0)
    pose = np.array([[0.0, 0, 0], [9, 9, 3], [0, 0, 0], [50, 0, 0]])
    assert not jumps(time, pose, np.ones_like(pose)).any()
