"""`slipid track` on made videos."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.helpers.made_drives import round_trip
from tests.helpers.made_sources import write_video
from tests.helpers.made_videos import Body, Printed, Stage, lens_of
from tests.helpers.shared import invoke

COUNT = 20
STAGE = Stage(lens_of(480), place=(0.1, 0.0, 1.6))
ROBOT = Body(round_trip())
OTHER = Body(lambda t: np.array([-0.3, 0.28 + 0.1 * t, 2.0]), (Printed(id=7),))
ASIDE = np.array([0.2, 0.1, 0.5])
FIVE = Body(round_trip(), (Printed(id=3, dictionary="5X5_50"),))
LONE = ("--marker-size", 0.131, "--marker-height", 0.25, "--quiet")


@dataclass(frozen=True)
class Made:
    """A folder with videos, and the camera that took them."""

    folder: Path

    @property
    def camera(self) -> Path:
        return self.folder / "camera.json"

    def video(self, name: str, *bodies: Body, count: int = COUNT) -> Path:
        path = self.folder / f"{name}.avi"
        return path if path.exists() else write_video(path, STAGE.film(bodies, count))


def made_in(folder: Path) -> Made:
    """The camera and the video that most tests need."""
    made = Made(folder)
    STAGE.camera.save(made.camera)
    made.video("robot", ROBOT)
    return made


def track(made: Made, source: object, out: Path, *words: object):
    return invoke("track", source, "--camera", made.camera, "--out", out, *words)


TARGETS = """
[[target]]
name = "one"
[[target.marker]]
id = 0
size_m = 0.131
height_m = 0.25
place_m = [0.1, -0.05]
yaw_deg = 30.0

[[target]]
name = "two"
[[target.board]]
first_id = 7
columns = 1
rows = 1
size_m = 0.131
gap_m = 0.01
height_m = 0.25
"""
