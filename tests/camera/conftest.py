"""Fixtures of tests with pictures: a calibrated board, and a floor with its map."""

from __future__ import annotations

import numpy as np
import pytest

from slipid.camera.calibration.calibrate import lens_from_pictures
from slipid.camera.floor.result import PictureMap
from slipid.support.progress import Reporter
from tests.helpers import made_boards
from tests.helpers.calibrated import ABOVE, BOARD, TRUE, WORDS
from tests.helpers.made_floors import POINTS, MadeFloor, made_floor
from tests.helpers.mapped_floors import REGION, mapped, marked
from tests.helpers.shared import invoke


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with pictures of the board, one of them with the board on the floor."""
    folder = tmp_path_factory.mktemp("pictures")
    for k, place in enumerate(made_boards.places()):
        made_boards.write(made_boards.photo(TRUE, place, k), folder / "lens" / f"view{k:02d}.png")
    made_boards.write(made_boards.photo(TRUE, ABOVE, 77), folder / "floor.png")
    made_boards.write(np.full((480, 640, 3), 128, np.uint8), folder / "empty.png")
    made_boards.write(np.full((240, 320, 3), 128, np.uint8), folder / "small.png")
    (folder / "nothing.png").write_bytes(b"")
    (folder / "words.png").write_text("no picture")
    return folder


@pytest.fixture(scope="module")
def calibrated(folder):
    """Return the lens calibrated by the pictures of the board."""
    return lens_from_pictures([str(folder / "lens")], BOARD, False, Reporter(quiet=True))


@pytest.fixture(scope="module")
def camera_file(folder):
    """Return the camera file that the command wrote, and its output."""
    out = folder / "out" / "camera.json"
    floor = ("--floor", folder / "floor.png")
    done = invoke("calibrate", folder / "lens", *WORDS, *floor, "--out", out, "--quiet")
    return out, done


@pytest.fixture(scope="module")
def made() -> MadeFloor:
    return made_floor()


@pytest.fixture(scope="module")
def by_points(made, tmp_path_factory) -> PictureMap:
    return mapped(made, tmp_path_factory.mktemp("points"), REGION + marked(POINTS))
