"""Maps of made floors, and their distance from the truth."""

from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from slipid.camera.floor.grid import RobotShape
from slipid.camera.floor.picture import MapOptions, map_of
from slipid.camera.floor.result import PictureMap
from slipid.support.progress import Reporter
from tests.helpers.made_floors import MadeFloor

REGION = "[region]\nat_m = [[-1.1, -0.9], [1.1, -0.9], [1.1, 0.9], [-1.1, 0.9]]\n"
HEAD = 'schema = "slipid.palette/1"\n'
IMAGE = Path("floor.png")
ROBOT = RobotShape("4X4_50", 0.17, 0.2)
REFERENCE = Path(__file__).parents[1] / "camera" / "floor" / "test_site_reference.json"
SITE_POINTS = {
    "tan": [(100, 60), (100, 300)],
    "navy": [(250, 130), (480, 450), (700, 930)],
    "green": [(300, 40), (900, 250), (700, 290)],
    "pale_green": [(600, 60), (960, 500), (300, 900)],
    "red": [(480, 140), (815, 460), (100, 600)],
    "pink": [(590, 200)],
    "dark_gray": [(370, 200), (600, 420)],
    "light_gray": [(500, 700), (70, 970), (960, 130)],
    "brown": [(250, 400), (700, 780), (930, 650)],
}
"""Points on surfaces of the test site, chosen by eye in pixels of its picture."""


def marked(points: dict, key: str = "at_m") -> str:
    """Return points as text of a config."""
    return "".join(
        f'[[points]]\nsurface = "{name}"\n{key} = {[list(p) for p in places]}\n'
        for name, places in points.items()
    )


def mapped(
    floor: MadeFloor, folder: Path, config: str | None, cell: float = 0.008, **options
) -> PictureMap:
    """Return the map of a made picture."""
    image, path = folder / "floor.png", None
    cv2.imwrite(str(image), floor.picture)
    if config is not None:
        path = folder / "palette.toml"
        path.write_text(HEAD + config)
    options.setdefault("robot", ROBOT)
    return map_of(image, floor.camera, MapOptions(path, cell=cell, **options), Reporter(quiet=True))


def truth_of(result: PictureMap, floor: MadeFloor) -> np.ndarray:
    """Return the true surface of each cell, by number of the map; -1 where the robot hides it."""
    names = list(result.vector.region.colours)
    centres = result.floor.grid.centres()
    number = np.array([names.index(name) for name in floor.truth.surfaces])
    return np.where(floor.hides(centres), -1, number[floor.truth.at(centres)])


def border_error(result: PictureMap, true: np.ndarray) -> np.ndarray:
    """Return the distance of each edge between two surfaces from the nearest true edge [m]."""
    known = (result.labels >= 0) & (true >= 0)
    far = distance_transform_edt(~_edges(true, known)) * result.floor.grid.cell
    return far[_edges(result.labels, known)]


def _edges(labels: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the cells whose right or upper neighbour is another surface."""
    out = np.zeros(labels.shape, bool)
    out[:, :-1] |= (labels[:, 1:] != labels[:, :-1]) & known[:, 1:] & known[:, :-1]
    out[:-1] |= (labels[1:] != labels[:-1]) & known[1:] & known[:-1]
    return out
