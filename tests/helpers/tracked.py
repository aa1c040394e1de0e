"""From made pictures to tracks, and how far these are from the truth."""

from __future__ import annotations

import numpy as np

from slipid.camera.tracking.finder import Finder, MarkerDetector
from slipid.camera.tracking.sightings import look_through
from slipid.camera.tracking.target import Marker, Target
from slipid.camera.tracking.track import Track, track_of
from slipid.support.checkpoint import Checkpoint
from tests.helpers.made_sources import InMemory
from tests.helpers.made_videos import Body, Printed, Stage
from tests.helpers.said import KeptMessages

STAGE = Stage()


def target_of(markers: tuple[Printed, ...] = (Printed(),), name: str = "robot") -> Target:
    """A body with these markers."""
    known = [Marker.at(m.id, m.size, m.height, (m.ahead, m.left), m.yaw) for m in markers]
    return Target(name, markers[0].dictionary, tuple(known))


def tracked(stage: Stage, pictures, tmp_path, *targets: Target, fps: float = 30.0) -> list[Track]:
    """Tracks of bodies through pictures, by default of one with the usual marker."""
    targets = targets or (target_of(),)
    ids = frozenset(number for target in targets for number in target.ids)
    finder = Finder(MarkerDetector(targets[0].dictionary), ids)
    source = InMemory.even(pictures, fps)
    seen = look_through(source, finder, Checkpoint(tmp_path / "kept", "key"), KeptMessages())
    return [track_of(stage.camera, target, seen) for target in targets]


def errors(track: Track, body: Body, fps: float = 30.0) -> np.ndarray:
    """Poses less the true ones."""
    off = track.pose - body.poses(len(track.frame), fps)
    off[:, 2] = np.angle(np.exp(1j * off[:, 2]))
    return off


def rms_mm(off: np.ndarray) -> float:
    return 1e3 * float(np.sqrt(np.nanmean((off[:, :2] ** 2).sum(axis=1))))


def nees(track: Track, off: np.ndarray) -> np.ndarray:
    """Squared errors over the stated covariance, of frames with a pose."""
    good = track.good
    inverse = np.linalg.inv(track.covariance[good])
    return np.einsum("ni,nij,nj->n", off[good], inverse, off[good])
