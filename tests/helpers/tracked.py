"""Tracked poses of made pictures, and their errors."""

from __future__ import annotations

import numpy as np

from slipid.camera.tracking.detections import detect_all
from slipid.camera.tracking.detector import MarkerDetector, MarkerTracker
from slipid.camera.tracking.target import Marker, Target
from slipid.camera.tracking.track import TrackedPoses, track_of
from slipid.support.checkpoint import Checkpoint
from tests.helpers.made_sources import InMemory
from tests.helpers.made_videos import Body, Printed, Stage
from tests.helpers.said import KeptMessages

STAGE = Stage()


def target_of(markers: tuple[Printed, ...] = (Printed(),), name: str = "robot") -> Target:
    """Return a body with these markers."""
    known = [Marker.at(m.id, m.size, m.height, (m.ahead, m.left), m.yaw) for m in markers]
    return Target(name, markers[0].dictionary, tuple(known))


def tracked(
    stage: Stage, pictures, tmp_path, *targets: Target, fps: float = 30.0
) -> list[TrackedPoses]:
    """Return the tracked poses of bodies in pictures, by default of one with the usual marker."""
    targets = targets or (target_of(),)
    ids = frozenset(number for target in targets for number in target.ids)
    tracker = MarkerTracker(MarkerDetector(targets[0].dictionary), ids)
    source = InMemory.even(pictures, fps)
    detections = detect_all(source, tracker, Checkpoint(tmp_path / "kept", "key"), KeptMessages())
    return [track_of(stage.camera, target, detections) for target in targets]


def errors(track: TrackedPoses, body: Body, fps: float = 30.0) -> np.ndarray:
    """Return the poses less the true ones."""
    off = track.pose - body.poses(len(track.frame), fps)
    off[:, 2] = np.angle(np.exp(1j * off[:, 2]))
    return off


def rms_mm(off: np.ndarray) -> float:
    return 1e3 * float(np.sqrt(np.nanmean((off[:, :2] ** 2).sum(axis=1))))


def nees(track: TrackedPoses, off: np.ndarray) -> np.ndarray:
    """Return the squared errors over the stated covariance, of frames with a pose."""
    good = track.good
    inverse = np.linalg.inv(track.covariance[good])
    return np.einsum("ni,nij,nj->n", off[good], inverse, off[good])
