"""Physics of surfaces, and contact parameters over the floor, with random unevenness and ribs."""

from collections.abc import Mapping
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int
from pydantic import Field
from pydantic.dataclasses import dataclass

from slipid.data.floor_map import MOST_CELLS, FloorMap
from slipid.data.wheel_signals import stretches
from slipid.support.quantities import Bounds
from slipid.support.toml_file import CLOSED

GRAVITY = 9.81
"""Gravitational acceleration [m/s^2]."""
LEVELS = 7
"""Number of levels to which the random unevenness of a floor is rounded."""
ARENA_HALF = 1.6
"""Half the edge length of the square floor around the start if there is a single surface [m]."""
GRID_CELL = 0.005
"""Cell size of the floor's lookup grid [m]; on very large floors the cells are larger."""

Pose = tuple[float, float, float]
"""Pose of the robot: x, y [m], heading [rad]."""


@dataclass(frozen=True, config=CLOSED)
class SurfacePhysics:
    """Physics of one surface.

    Attributes:
        friction: Coulomb friction coefficient between a roller or wheel and the surface [1].
        rolling_m: lever arm of the rolling friction, about both axes of a roller, or about the axle
            of an ordinary wheel [m].
        softness_m: approximate sinkage of a wheel that carries a third of the robot, for any weight
            of the robot [m].
        shear_n_m: horizontal stiffness of the floor beneath one roller or ordinary wheel [N/m].
        compaction: resistance force of a sunk wheel over its sinkage to the power of 1.5
            [N/m^1.5].
        body_drag_n: drag force against translation of the body, as by a deep carpet pile [N].
        rib_height_m, rib_distance_m: height of ribs along y, and distance between them [m]; by
            default there are none.
        unevenness: std, over the floor, of the logarithm of rolling friction and shear stiffness
            [1].
        colour: colour in videos, as `#rrggbb`.
    """

    friction: Annotated[float, Bounds(1e-3, 10)] = 0.8
    rolling_m: Annotated[float, Bounds(0, 0.05, "m")] = 0.0003
    softness_m: Annotated[float, Bounds(1e-9, 0.03, "m")] = 0.0003
    shear_n_m: Annotated[float, Bounds(50, 1e12, "N/m")] = 1e5
    compaction: Annotated[float, Bounds(0, 1e7, "N/m^1.5")] = 0.0
    body_drag_n: Annotated[float, Bounds(0, 1000, "N")] = 0.0
    rib_height_m: Annotated[float, Bounds(0, 0.02, "m")] = 0.0
    rib_distance_m: Annotated[float, Bounds(1e-3, 10, "m")] = 0.03
    unevenness: Annotated[float, Bounds(0, 1)] = 0.0
    colour: Annotated[str, Field(pattern="^#[0-9a-fA-F]{6}$")] = "#d9d4c7"

    @property
    def settling_s(self) -> float:
        """Time constant t of the engine's contact spring [s]; a wheel sinks by about 1.9 g t^2."""
        return float((self.softness_m / (1.9 * GRAVITY)) ** 0.5)


# positional arguments: friction, rolling_m, softness_m, shear_n_m, compaction, body_drag_n, ...
SURFACES: dict[str, SurfacePhysics] = {
    "firm": SurfacePhysics(rolling_m=0.0004, unevenness=0.05, colour="#e8e4da"),
    "short": SurfacePhysics(0.75, 0.0008, 0.001, 1.2e4, 2e4, unevenness=0.1, colour="#8a5a35"),
    "medium": SurfacePhysics(0.8, 0.0018, 0.004, 4.5e3, 4e3, unevenness=0.15, colour="#8f9194"),
    "soft": SurfacePhysics(0.8, 0.0028, 0.007, 2.2e3, 3e3, 0.5, unevenness=0.15, colour="#1f6b45"),
    "ribbed": SurfacePhysics(0.6, 0.0006, 0.001, 2e4, 0.0, 0.0, 0.0012, 0.02, 0.05, "#3f4a5a"),
}
"""Built-in surfaces, keyed by name: a bare floor, three carpets of increasing depth, a ribbed mat.
"""


class Terrain:
    """The floor around a start, divided into kinds: a kind is a surface at a level of unevenness.

    Attributes:
        kinds: for each kind, its surface, and the factor by which its rolling friction and its
            shear compliance are multiplied.
    """

    def __init__(
        self,
        floor: FloorMap,
        surfaces: Mapping[str, SurfacePhysics],
        start: Pose,
        rng: np.random.Generator,
    ):
        own = [surfaces[name] for name in floor.surfaces]
        levels = np.linspace(-1.5, 1.5, LEVELS)
        self.kinds = [(g, np.exp(g.unevenness * v)) for g in own for v in levels]
        x0, y0, x1, y1 = arena(floor, start)
        self._corner = np.array([x0, y0])
        self._cell = max(GRID_CELL, ((x1 - x0) * (y1 - y0) / MOST_CELLS) ** 0.5)
        x = np.arange(x0, x1, self._cell) + 0.5 * self._cell
        y = np.arange(y0, y1, self._cell) + 0.5 * self._cell
        surface = floor.at(np.stack(np.meshgrid(x, y), -1))
        self._kinds = surface * LEVELS + _random_levels(x, y, rng)

    def at(self, xy: Float[np.ndarray, "place 2"]) -> Int[np.ndarray, " place"]:
        """Return the index of the kind at each position [m]."""
        column, row = ((xy - self._corner) * (1 / self._cell)).astype(np.intp).T
        rows, columns = self._kinds.shape
        return self._kinds[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]


def _random_levels(
    x: Float[np.ndarray, " column"], y: Float[np.ndarray, " row"], rng: np.random.Generator
) -> np.ndarray:
    """Return the levels (row, column) of a smooth random field.

    The field is a sum of plane waves with wavelengths of 8 to 30 cm.
    """
    waves = 6
    angle = rng.uniform(0, 2 * np.pi, waves)
    number = 2 * np.pi / rng.uniform(0.08, 0.3, waves)
    phase = rng.uniform(0, 2 * np.pi, waves)
    field = np.zeros((len(y), len(x)))
    # add sin(u + v) of each wave by the addition theorem: sines of vectors, not of the whole grid
    for a, k, p in zip(angle, number, phase, strict=True):
        u, v = k * np.cos(a) * x + p, k * np.sin(a) * y
        field += np.outer(np.cos(v), np.sin(u)) + np.outer(np.sin(v), np.cos(u))
    field *= (2 / waves) ** 0.5
    return np.clip(np.rint((field + 1.5) / 3 * (LEVELS - 1)), 0, LEVELS - 1).astype(np.intp)


def arena(floor: FloorMap, start: Pose) -> tuple[float, float, float, float]:
    """Return lowest x, lowest y, highest x, highest y of the floor around a start [m].

    For a map with several surfaces this is the whole map, for a single surface a square around the
    start.
    """
    if len(floor.surfaces) > 1:
        return floor.extent
    x, y, _ = start
    return x - ARENA_HALF, y - ARENA_HALF, x + ARENA_HALF, y + ARENA_HALF


def ribs(
    floor: FloorMap, surfaces: Mapping[str, SurfacePhysics], start: Pose
) -> list[tuple[float, float, float, float]]:
    """Return x, lowest y, highest y and height of each rib along y within the arena [m]."""
    out: list[tuple[float, float, float, float]] = []
    left, low, right, high = arena(floor, start)
    fine = min(floor.cell, 0.02)
    y = np.arange(low + 0.5 * fine, high, fine)
    for number, name in enumerate(floor.surfaces):
        surface = surfaces[name]
        if surface.rib_height_m <= 0:
            continue
        for x in np.arange(left, right, surface.rib_distance_m):
            on = floor.at(np.stack([np.full_like(y, x), y], 1)) == number
            out += [
                (float(x), low + fine * float(a), low + fine * float(b), surface.rib_height_m)
                for a, b in stretches(on)
            ]
    return out
