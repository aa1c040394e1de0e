"""Pictures of made floors: known patches, uneven light, a camera aslant, a robot with a marker."""

from dataclasses import dataclass, field

import cv2
import numpy as np

from slipid.camera.floor.light import to_linear, to_srgb
from slipid.camera.overhead import Lens, OverheadCamera
from slipid.data.floor_map import FloorMap, from_polygons

COLOURS = {
    "wood": "#b08a5a",
    "green": "#3e7a4c",
    "blue": "#3f5578",
    "red": "#a8423c",
    "gray": "#8f8d8a",
}
EXTENT = (-1.2, -1.0, 1.2, 1.0)
PATCHES = [
    ("green", [[-1.2, -1.0], [-0.35, -1.0], [-0.2, 0.1], [-1.2, 0.25]]),
    ("blue", [[-0.1, 0.2], [0.5, 0.3], [0.45, 1.0], [-0.25, 1.0]]),
    ("red", [[0.35, -1.0], [1.2, -1.0], [1.2, -0.1], [0.5, -0.35]]),
    ("gray", [[-0.15, -0.7], [0.15, -0.7], [0.15, -0.3], [-0.15, -0.3]]),
    ("gray", [[0.75, 0.2], [1.2, 0.15], [1.2, 1.0], [0.8, 1.0]]),
]
"""On wood."""
CORNER = 0.07
"""Half of the edge of a marker [m]."""


@dataclass(frozen=True)
class MadeRobot:
    """An upright cylinder with a marker on its lid."""

    x: float = -0.75
    y: float = 0.55
    radius: float = 0.16
    height: float = 0.2


@dataclass(frozen=True)
class Flaws:
    """What makes a picture worse than a drawing.

    Attributes:
        shade: by which part the light falls from one side to the other.
        glare: light added at the brightest spot.
        rough: standard deviation of the floor's texture, as a part of its light.
        noise: of the camera, of 255.
    """

    shade: float = 0.35
    glare: float = 0.18
    rough: float = 0.05
    noise: float = 2.0


@dataclass(frozen=True, eq=False)
class MadeFloor:
    """A picture in blue, green, red, and all that is true of it."""

    picture: np.ndarray
    camera: OverheadCamera
    truth: FloorMap
    robot: MadeRobot | None
    points: dict[str, list[tuple[float, float]]] = field(default_factory=dict)

    def hides(self, xy: np.ndarray) -> np.ndarray:
        """Whether the robot stands between the lens and places on the floor [m]."""
        if self.robot is None:
            return np.zeros(xy.shape[:-1], bool)
        hidden = np.zeros(xy.shape[:-1], bool)
        for height in np.linspace(0, self.robot.height, 12):
            at = _raised(xy, self.camera, float(height))
            hidden |= np.hypot(at[..., 0] - self.robot.x, at[..., 1] - self.robot.y) < (
                self.robot.radius
            )
        return hidden


POINTS = {
    "wood": [(0.3, 0.0), (-0.4, 0.7)],
    "green": [(-0.8, -0.5), (-0.4, -0.1)],
    "blue": [(0.2, 0.6), (0.0, 0.75)],
    "red": [(0.9, -0.6), (0.6, -0.8)],
    "gray": [(0.0, -0.5), (1.0, 0.6)],
}
"""On the surfaces [m]."""


def aslant(width: int = 480, height: int = 400, pitch: float = 0.25) -> OverheadCamera:
    """A camera 1.9 m above the floor that is tilted [rad] and bends straight lines."""
    focal = 0.72 * width
    matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    down = np.diag([1.0, -1.0, -1.0])
    c, s = np.cos(pitch), np.sin(pitch)
    rotation = np.array([[1, 0, 0], [0, c, s], [0, -s, c]]) @ down
    lens = Lens((width, height), matrix, np.array([-0.08, 0.02, 0.0, 0.0]))
    return OverheadCamera(lens, rotation, np.array([0.0, -0.45, 1.9]))


ROBOT, FLAWS = MadeRobot(), Flaws()


def made_floor(
    camera: OverheadCamera | None = None,
    robot: MadeRobot | None = ROBOT,
    flaws: Flaws = FLAWS,
    patches: list = PATCHES,
    colours: dict[str, str] = COLOURS,
) -> MadeFloor:
    """A picture of patches on wood."""
    camera = camera or aslant()
    truth = from_polygons("wood", patches, EXTENT, 0.004)
    width, height = camera.lens.image_px
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(float)
    # a pixel on an edge shows a mixture
    parts = [(dx, dy) for dx in (-0.25, 0.25) for dy in (-0.25, 0.25)]
    light = np.mean([_seen(pixels + part, camera, truth, robot, colours) for part in parts], axis=0)
    light = _worse(light, flaws)
    noise = np.random.default_rng(1).normal(0, flaws.noise, light.shape)
    shown = np.clip(255 * to_srgb(light) + noise, 0, 255).astype(np.uint8)
    return MadeFloor(np.ascontiguousarray(shown[..., ::-1]), camera, truth, robot, POINTS)


def _seen(
    pixels: np.ndarray,
    camera: OverheadCamera,
    truth: FloorMap,
    robot: MadeRobot | None,
    colours: dict,
) -> np.ndarray:
    """Amounts of light before the light is uneven."""
    floor = np.nan_to_num(camera.on_plane(pixels, 0.0), nan=99.0)
    light = np.array([_light(colours[name]) for name in truth.surfaces])[truth.at(floor)]
    x0, y0, x1, y1 = truth.extent
    out = ((floor < [x0, y0]) | (floor > [x1, y1])).any(axis=-1)
    light[out] = _light("#14181c")
    if robot is None:
        return light
    for height in np.linspace(0, robot.height, 12):
        at = _raised(floor, camera, float(height)) - [robot.x, robot.y]
        light[np.hypot(at[..., 0], at[..., 1]) < robot.radius] = 0.25 + 0.4 * height
    inside = (np.abs(at) < 1.35 * CORNER).all(axis=-1)
    light[inside] = 0.8
    marker = cv2.aruco.generateImageMarker(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 7, 60
    )
    cell = np.floor((at / CORNER + 1) * 30).astype(int)
    on = ((cell >= 0) & (cell < 60)).all(axis=-1)
    light[on] = np.where(marker[59 - cell[on][:, 1], cell[on][:, 0]] > 0, 0.8, 0.02)[:, None]
    return light


def _raised(floor: np.ndarray, camera: OverheadCamera, height: float) -> np.ndarray:
    """Where rays that end at places on the floor pass a height [m]."""
    return floor + height / camera.height * (camera.place[:2] - floor)


def _worse(light: np.ndarray, flaws: Flaws) -> np.ndarray:
    """Texture, shading, the darker edge of a lens, and glare."""
    height, width = light.shape[:2]
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    rng = np.random.default_rng(0)
    grain = cv2.GaussianBlur(rng.normal(0, 1, light.shape[:2]), (0, 0), 0.8)
    grain *= flaws.rough / grain.std()
    gain = (1 - flaws.shade * (0.5 + 0.5 * x)) * (1 - 0.6 * flaws.shade * (x**2 + y**2) / 2)
    veil = flaws.glare * np.exp(-((x + 0.2) ** 2 + (y + 0.5) ** 2) / 0.35)
    return light * (gain * (1 + grain))[..., None] + veil[..., None] * [1.0, 1.0, 1.05]


def _light(code: str) -> np.ndarray:
    return to_linear(np.array([int(code[k : k + 2], 16) for k in (1, 3, 5)]) / 255)
