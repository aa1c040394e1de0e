"""Tracking against nothing but OpenCV's detector on the same frames, and how accurate it is.

    .venv/bin/python -m pytest -s -o python_files='bench_*.py' tests/benchmarks/bench_tracking.py

Speed: `slipid track` from the file to the poses, decoding included, over looking through the same
frames, decoded beforehand, with `cv2.aruco.ArucoDetector`; with the detector's defaults, and with
its refinement of corners. Both run in turns, and ratios are medians.

Accuracy: the virtual test site drives, films itself in 1080p, and its poses are compared with the
truth: errors, and whether the stated covariance covers them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from slipid.camera.frame_source import open_source
from slipid.camera.overhead import Lens, OverheadCamera
from slipid.camera.tracking.tracking import LoneMarker, track
from slipid.data.floor_map import uniform
from slipid.lab.testsite.site import Site, SiteCamera
from slipid.support.errors import DataError
from slipid.support.progress import Reporter
from tests.benchmarks.quick import QUICK, quick
from tests.helpers.made_drives import round_trip
from tests.helpers.made_sources import write_video
from tests.helpers.made_videos import Body, Stage, lens_of

TURNS = quick(3, 1)
FRAMES = quick(120, 6)
ROBOT = LoneMarker(0.131, 0.25, 0)


def seconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, OverheadCamera]:
    """A made video in 1080p."""
    stage = Stage(lens_of(1920))
    path = tmp_path_factory.mktemp("video") / "robot.avi"
    return write_video(path, stage.film([Body(round_trip())], FRAMES)), stage.camera


def decoded(path: Path) -> list[np.ndarray]:
    """Every frame of a video, grey."""
    capture, frames = cv2.VideoCapture(str(path)), []
    while (read := capture.read())[0]:
        frames.append(cv2.cvtColor(read[1], cv2.COLOR_BGR2GRAY))
    return frames


def bare(frames: list[np.ndarray], refine: int) -> int:
    """Markers found by a loop that does nothing else."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = refine
    book = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    detector = cv2.aruco.ArucoDetector(book, parameters)
    return sum(detector.detectMarkers(grey)[1] is not None for grey in frames)


def test_speed(video, tmp_path):
    path, camera = video
    frames = decoded(path)

    def whole() -> None:
        source = open_source(str(path))
        done = track(
            *(
                source,
                camera,
                (ROBOT.target(source, Reporter(quiet=True)),),
                tmp_path / "kept",
                Reporter(quiet=True),
            )
        )
        done.write(tmp_path / "poses.csv")

    plain, refined = cv2.aruco.CORNER_REFINE_NONE, cv2.aruco.CORNER_REFINE_SUBPIX
    took = np.array(
        [
            [seconds(whole), *(seconds(lambda r=r: bare(frames, r)) for r in (plain, refined))]
            for _ in range(TURNS)
        ]
    )
    rate = FRAMES / np.median(took, axis=0)
    ratio = np.median(took[:, 1:] / took[:, :1], axis=0)
    print(
        f"\n{rate[0]:.0f} frames/s tracked; detector alone {rate[1]:.0f}, with refined corners "
        f"{rate[2]:.0f}: ratios {ratio[0]:.2f} and {ratio[1]:.2f}"
    )
    assert QUICK or ratio.min() >= 0.8


@pytest.mark.parametrize("speed", quick([0.0, 0.1, 0.3], [0.1]))
def test_accuracy_on_the_test_site(tmp_path, speed):
    from slipid.lab.testsite.studio import Studio, film

    camera, site = SiteCamera(), Site()
    try:
        studio = Studio(site, "as_built", uniform(next(iter(site.surfaces))), camera, seed=5)
    except DataError as error:
        pytest.skip(str(error))
    at = np.arange(0, 3, 0.01)
    path = round_trip(speed, 3 * speed)
    true = {
        "time": at,
        "pose": np.array([path(t) for t in at]),
        "wheel_angle": np.zeros((len(at), len(site.robot.wheel_azimuths_deg))),
    }
    frames = np.arange(0.1, quick(2.8, 0.6), camera.frame_s)
    film(studio, true, frames, tmp_path / "run.avi")
    studio.close()
    lens = Lens(
        (camera.width_px, camera.height_px), camera.matrix, np.array(camera.distortion, float)
    )
    above = OverheadCamera(lens, camera.rotation, camera.place)
    source = open_source(str(tmp_path / "run.avi"))
    robot = site.robot
    yaw = float(np.radians(robot.marker_yaw_deg))
    marker = LoneMarker(robot.marker_size_m, robot.marker_height_m, 0, yaw=yaw)
    done = track(
        *(
            source,
            above,
            (marker.target(source, Reporter(quiet=True)),),
            tmp_path / "kept",
            Reporter(quiet=True),
        )
    ).tracks[0]
    off = done.pose - np.array([path(t) for t in frames])
    off[:, 2] = np.angle(np.exp(1j * off[:, 2]))
    off, covariance = off[done.good], done.covariance[done.good]
    squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off)
    position = 1e3 * np.sqrt((off[:, :2] ** 2).sum(axis=1).mean())
    angle = np.degrees(np.sqrt((off[:, 2] ** 2).mean()))
    print(
        f"\n{speed} m/s: {done.summary()}; errors {position:.3f} mm, "
        f"{angle:.3f} deg, NEES {squares.mean():.2f}, in the 90 % region "
        f"{100 * (squares < 6.25).mean():.0f} %"
    )
    assert QUICK or position <= 1.5
    assert QUICK or angle <= 0.3
    assert QUICK or squares.mean() <= 3
