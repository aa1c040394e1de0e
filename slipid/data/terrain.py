"""Floor maps: which surface lies where, from polygons or from the picture of a site."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from slipid.data.files import write_bytes
from slipid.data.log import DataError

SCHEMA = "slipid.map/1"
MOST_CELLS = 16_000_000
"""Of one map."""
_PATCH = ("surface", "polygon")
_KEYS = (
    "schema",
    "base",
    "cell_m",
    "extent_m",
    "patch",
    "picture",
    "metres_per_pixel",
    "corner_m",
    "colours",
)


@dataclass(frozen=True, eq=False)
class FloorMap:
    """A floor in square cells, each with one surface.

    Attributes:
        surfaces: names; `cells` counts them from 0.
        cells: surface of each cell, the first row at the lowest y.
        corner: x, y of the corner with the lowest coordinates [m].
        cell: edge of a cell [m].
    """

    surfaces: tuple[str, ...]
    cells: Int[np.ndarray, "row column"]
    corner: tuple[float, float]
    cell: float

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Lowest x, lowest y, highest x, highest y [m]."""
        rows, columns = self.cells.shape
        x, y = self.corner
        return x, y, x + columns * self.cell, y + rows * self.cell

    def at(self, xy: Float[np.ndarray, "*batch 2"]) -> Int[np.ndarray, "*batch"]:
        """Surface at places [m], by number; beyond the edge that of the nearest cell."""
        steps = np.floor((np.asarray(xy) - self.corner) / self.cell).astype(np.intp)
        rows, columns = self.cells.shape
        row, column = steps[..., 1].clip(0, rows - 1), steps[..., 0].clip(0, columns - 1)
        return np.asarray(self.cells[row, column])

    def surface_at(self, x: float, y: float) -> str:
        """Name of the surface at a place [m]."""
        return self.surfaces[int(self.at(np.array([x, y])))]


def uniform(surface: str, half: float = 2.0) -> FloorMap:
    """One surface everywhere."""
    return FloorMap((surface,), np.zeros((1, 1), np.intp), (-half, -half), 2 * half)


def from_polygons(
    base: str,
    patches: Sequence[tuple[str, Sequence[Sequence[float]]]],
    extent: tuple[float, float, float, float],
    cell: float = 0.005,
) -> FloorMap:
    """Map from patches on a base, later ones on top of earlier ones.

    Args:
        base: surface where no patch lies.
        patches: surface and corners (x, y) [m] of each.
        extent: lowest x, lowest y, highest x, highest y [m].
        cell: edge of a cell [m].

    Raises:
        ValueError: more than `MOST_CELLS` cells.
    """
    from matplotlib.path import Path as Outline

    surfaces = tuple(dict.fromkeys([base, *(name for name, _ in patches)]))
    columns, rows = (max(1, round((extent[2 + k] - extent[k]) / cell)) for k in range(2))
    _few(rows * columns)
    x = extent[0] + (np.arange(columns) + 0.5) * cell
    y = extent[1] + (np.arange(rows) + 0.5) * cell
    centres = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    cells = np.zeros(len(centres), np.intp)
    for name, corners in patches:
        cells[Outline(np.asarray(corners, float)).contains_points(centres)] = surfaces.index(name)
    return FloorMap(surfaces, cells.reshape(rows, columns), (extent[0], extent[1]), cell)


def from_picture(
    picture: Float[np.ndarray, "row column 3"],
    colours: Mapping[str, str],
    metres_per_pixel: float,
    corner: tuple[float, float] = (0.0, 0.0),
) -> FloorMap:
    """Map from a picture seen from above, x to the right, y up: each pixel the nearest colour's.

    Args:
        picture: red, green, blue between 0 and 1, first row at the top.
        colours: of every surface, as `#rrggbb`.
        metres_per_pixel: [m].
        corner: x, y of the lower left corner [m].
    """
    names = tuple(colours)
    wanted = np.array([_rgb(colours[name]) for name in names])
    far = np.linalg.norm(picture[:, :, None, :] - wanted, axis=-1)
    return FloorMap(names, np.argmin(far, axis=-1)[::-1].copy(), corner, metres_per_pixel)


def patchwork(
    surfaces: Sequence[str],
    seed: int,
    patch: float = 0.25,
    half: float = 1.2,
    cell: float = 0.005,
) -> FloorMap:
    """Random site of patches, by default smaller than a Robotino: cells of a jittered grid.

    Args:
        surfaces: to choose from.
        seed: of the jitter and of the choice.
        patch: mean distance of neighbouring patches [m].
        half: half of the site's edge [m].
        cell: edge of a cell [m].

    Raises:
        ValueError: too many cells or patches.
    """
    _few(round(2 * half / cell) ** 2)
    count = int(np.ceil(2 * half / patch)) + 2
    if count > 500:
        raise ValueError(f"{count} x {count} patches; expected at most 500 x 500")
    rng = np.random.default_rng(seed)
    grid = (np.arange(count) - 0.5 * (count - 1)) * patch
    seeds = np.stack(np.meshgrid(grid, grid), -1).reshape(-1, 2)
    seeds = seeds + rng.uniform(-0.35, 0.35, seeds.shape) * patch
    own = rng.integers(len(surfaces), size=len(seeds))
    x = np.arange(-half + 0.5 * cell, half, cell)
    centres = np.stack(np.meshgrid(x, x), -1)
    nearest = np.full(centres.shape[:2], np.inf)
    cells = np.zeros(centres.shape[:2], np.intp)
    for place, surface in zip(seeds, own, strict=True):
        far = np.linalg.norm(centres - place, axis=-1)
        cells[far < nearest] = surface
        nearest = np.minimum(nearest, far)
    return FloorMap(tuple(surfaces), cells, (-half, -half), cell)


def four_zones(
    surfaces: Sequence[str], middle: tuple[float, float] = (0.45, -0.2), reach: float = 1.2
) -> FloorMap:
    """Four surfaces that meet in a point, by default the middle of the paper's rectangle.

    Args:
        surfaces: of the quarters: low x and high y, high x and high y, high x and low y, the rest.
        middle: x, y [m].
        reach: of every zone from there [m].
    """
    x, y = middle
    corners = (
        [[x - reach, y], [x, y], [x, y + reach], [x - reach, y + reach]],
        [[x, y], [x + reach, y], [x + reach, y + reach], [x, y + reach]],
        [[x, y - reach], [x + reach, y - reach], [x + reach, y], [x, y]],
        [[x - reach, y - reach], [x, y - reach], [x, y], [x - reach, y]],
    )
    patches = list(zip(surfaces, corners, strict=True))
    return from_polygons(surfaces[0], patches, (x - reach, y - reach, x + reach, y + reach))


def read_map(path: Path) -> FloorMap:
    """Map from a TOML file: `base`, `extent_m` and `[[patch]]`, or `picture` and `[colours]`.

    Raises:
        DataError: unreadable, unknown or missing keys, wrong values.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; expected a floor map (TOML file)") from error
    except ValueError as error:
        raise DataError(f"{path}: no valid TOML: {error}") from error
    for key in content:
        if key not in _KEYS:
            raise DataError(f"{path}: no such key '{key}'; expected one of {', '.join(_KEYS)}")
    if content.get("schema") != SCHEMA:
        raise DataError(f"{path}: schema {content.get('schema')!r}; expected '{SCHEMA}'")
    return _pictured(path, content) if "picture" in content else _patched(path, content)


def write_map(path: Path, floor: FloorMap, colours: Mapping[str, str]) -> None:
    """Write a map as a picture and a TOML file beside it that `read_map` reads.

    Args:
        path: of the TOML file; the picture has its name.
        floor: the map.
        colours: of every surface, as `#rrggbb`, all different.

    Raises:
        ValueError: two surfaces have one colour.
        DataError: nothing can be written there.
    """
    from matplotlib.image import imsave

    table = np.array([_rgb(colours[name]) for name in floor.surfaces])
    if len(np.unique(table, axis=0)) < len(table):
        raise ValueError(f"surfaces with the same colour: {dict(colours)}; expected others")
    picture = BytesIO()
    imsave(picture, table[floor.cells[::-1]], format="png")
    write_bytes(path.with_suffix(".png"), picture.getvalue())
    lines = [
        f'schema = "{SCHEMA}"',
        f'picture = "{path.with_suffix(".png").name}"',
        f"metres_per_pixel = {floor.cell}",
        f"corner_m = [{floor.corner[0]}, {floor.corner[1]}]",
        "",
        "[colours]",
        *(f'"{name}" = "{colours[name]}"' for name in floor.surfaces),
    ]
    write_bytes(path, ("\n".join(lines) + "\n").encode())


def _patched(path: Path, content: Mapping[str, Any]) -> FloorMap:
    base = content.get("base")
    if not isinstance(base, str):
        raise DataError(f"{path}: base {base!r}; expected the surface where no patch lies")
    extent = _numbers(path, "extent_m", content.get("extent_m"), (4,))
    if not (extent[0] < extent[2] and extent[1] < extent[3]):
        raise DataError(
            f"{path}: extent_m {extent.tolist()}; expected lowest x, y, then highest x, y"
        )
    cell = float(_numbers(path, "cell_m", content.get("cell_m", 0.005), ()))
    if not 0 < cell <= 1:
        raise DataError(f"{path}: cell_m {cell}; expected above 0, at most 1")
    patches = []
    given = content.get("patch", [])
    if not isinstance(given, list):
        raise DataError(f"{path}: patch {given!r}; expected sections [[patch]]")
    for k, patch in enumerate(given, 1):
        if not isinstance(patch, Mapping) or not isinstance(patch.get("surface"), str):
            raise DataError(f"{path}: patch {k} has no surface; expected a name")
        for key in patch:
            if key not in _PATCH:
                raise DataError(f"{path}: patch {k}: no such key '{key}'; expected {_PATCH}")
        corners = _numbers(path, f"polygon of patch {k}", patch.get("polygon"), (None, 2))
        if len(corners) < 3:
            raise DataError(f"{path}: patch {k}: {len(corners)} corners; expected three or more")
        patches.append((patch["surface"], corners.tolist()))
    x0, y0, x1, y1 = (float(v) for v in extent)
    try:
        return from_polygons(base, patches, (x0, y0, x1, y1), cell)
    except ValueError as error:
        raise DataError(f"{path}: {error}") from error


def _pictured(path: Path, content: Mapping[str, Any]) -> FloorMap:
    from matplotlib.image import imread

    colours = content.get("colours")
    if not isinstance(colours, Mapping) or not colours:
        raise DataError(f"{path}: no [colours]; expected a colour '#rrggbb' of every surface")
    for name, colour in colours.items():
        if not isinstance(colour, str) or len(colour) != 7 or colour[0] != "#":
            raise DataError(f"{path}: colour of {name} is {colour!r}; expected '#rrggbb'")
    scale = float(_numbers(path, "metres_per_pixel", content.get("metres_per_pixel"), ()))
    if not 1e-5 <= scale <= 1:
        raise DataError(f"{path}: metres_per_pixel {scale}; expected 0.00001 to 1")
    for key in ("base", "patch", "cell_m", "extent_m"):
        if key in content:
            raise DataError(f"{path}: {key} beside picture; expected one or the other")
    corner = _numbers(path, "corner_m", content.get("corner_m", [0.0, 0.0]), (2,))
    source = path.parent / str(content["picture"])
    try:
        picture = np.asarray(imread(source), float)
    except (OSError, ValueError, SyntaxError) as error:
        raise DataError(f"{path}: picture {source}: {error}; expected a PNG or JPEG") from error
    if picture.ndim == 2:  # shades of grey
        picture = np.repeat(picture[..., None], 3, axis=2)
    if picture.shape[0] * picture.shape[1] > MOST_CELLS:
        raise DataError(f"{path}: picture {source}: expected at most {MOST_CELLS} pixels")
    picture = picture[..., :3] if picture.max() <= 1 else picture[..., :3] / 255
    try:
        return from_picture(picture, colours, scale, (float(corner[0]), float(corner[1])))
    except ValueError as error:
        raise DataError(f"{path}: {error}") from error


def _numbers(path: Path, key: str, value: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    try:
        found = np.asarray(value, float)
    except (TypeError, ValueError):
        found = np.array(np.nan)
    fits = found.ndim == len(shape) and all(
        n is None or n == m for n, m in zip(shape, found.shape, strict=True)
    )
    if not fits or not np.isfinite(found).all():
        wanted = (
            "a number" if not shape else f"numbers ({' x '.join(str(n or 'n') for n in shape)})"
        )
        raise DataError(f"{path}: {key} {value!r}; expected {wanted}")
    return found


def _few(cells: int) -> None:
    if cells > MOST_CELLS:
        raise ValueError(f"{cells} cells; expected at most {MOST_CELLS}: a larger cell, less floor")


def _rgb(colour: str) -> list[float]:
    try:
        return [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    except ValueError as error:
        raise ValueError(f"colour {colour!r}; expected '#rrggbb'") from error
