"""A board, a known lens, and projected corners of both, without drawing pictures."""

from __future__ import annotations

import cv2
import numpy as np

from slipid.camera.calibration.board import Board, Picture, View
from slipid.camera.calibration.lens import fit_robustly
from slipid.camera.calibration.points import FloorPoints
from slipid.camera.calibration.quality import quality_of
from slipid.camera.calibration.views import check_enough
from slipid.camera.overhead import Lens
from tests.helpers import made_boards as made

TRUE = made.TrueLens()
SIZE = (TRUE.width, TRUE.height)
NUMBERS = np.array([TRUE.fx, TRUE.fy, TRUE.cx, TRUE.cy, *TRUE.bend])
LENS = Lens(
    SIZE,
    np.array([[TRUE.fx, 0, TRUE.cx], [0, TRUE.fy, TRUE.cy], [0, 0, 1]]),
    np.array(TRUE.bend),
)
BOARD = Board(made.COLUMNS, made.ROWS, made.SQUARE, made.MARKER)
WORDS = ("--board", "7x5", "--square", "0.04", "--marker", "0.03")
NOISE = 0.2
CAMERA = (0.05, -0.03, 0.6)
ABOVE = made.overhead(3.0, -4.0, 10.0, CAMERA)


GRID = [(x, y, 0.0) for x in (-0.9, -0.3, 0.4, 1.0) for y in (-0.7, 0.0, 0.6)]


def projected_views(places, noise=NOISE, seed=0) -> list[View]:
    """Return the corners that a lens sees inside of the picture."""
    rng, views = np.random.default_rng(seed), []
    corners = BOARD.corners_m
    for k, place in enumerate(places):
        solid = np.c_[corners, np.zeros(len(corners))]
        pixels = TRUE.project(solid @ place.rotation.T + place.shift)
        pixels = pixels + noise * rng.standard_normal(pixels.shape)
        inside = ((pixels > 0) & (pixels < SIZE)).all(1)
        views.append(View(f"view{k}", pixels[inside], corners[inside]))
    return views


def floor_points(places, camera=(0.1, -0.2, 2.4), tilt=(3.0, -4.0), noise=0.3, seed=0):
    """Return points of the world as the lens sees them, and the rotation of its camera."""
    rotation = made.from_world(made.overhead(*tilt, 10.0, camera))
    places = np.asarray(places, float)
    pixels = TRUE.project((places - np.array(camera)) @ rotation.T)
    pixels = pixels + noise * np.random.default_rng(seed).standard_normal(pixels.shape)
    names = tuple(f"row {k}" for k in range(2, len(places) + 2))
    return FloorPoints(names, pixels, places), rotation


def quality_of_views(views):
    """Return a lens fitted to views as the command does, with its quality."""
    check_enough(views)
    return quality_of(fit_robustly(views, SIZE, False), False)


def log_length(camera) -> float:
    """Return the mean log length on the floor along a grid over the middle of the picture."""
    rows = [[(u, v) for u in np.linspace(64, 576, 5)] for v in np.linspace(48, 432, 5)]
    floor = camera.on_plane(np.array(rows), 0.0)
    steps = [
        *(floor[1:] - floor[:-1]).reshape(-1, 2),
        *(floor[:, 1:] - floor[:, :-1]).reshape(-1, 2),
    ]
    return float(np.mean(np.log(np.hypot(*np.transpose(steps)))))


def directions(lens, pixels):
    """Return unit vectors along the rays of pixels."""
    rays = np.concatenate([lens.ideal(pixels), np.ones((*pixels.shape[:-1], 1))], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def picture(path) -> Picture:
    """Return a picture as it is read from a file."""
    return Picture(path, cv2.imread(str(path)))
