"""Floor maps as TOML files: patches on a base, or a picture with the colours of its surfaces."""

import tomllib
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path

import numpy as np

from slipid.data.floor_map import MOST_CELLS, FloorMap, from_picture, from_polygons, rgb
from slipid.support.errors import DataError
from slipid.support.files import write_bytes

SCHEMA = "slipid.map/1"
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
        path: where the TOML file goes; the picture has its name.
        floor: the map.
        colours: colour of every surface as `#rrggbb`, all different.

    Raises:
        ValueError: two surfaces have one colour.
        DataError: nothing can be written there.
    """
    from matplotlib.image import imsave

    table = np.array([rgb(colours[name]) for name in floor.surfaces])
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


def _patched(path: Path, content: Mapping[str, object]) -> FloorMap:
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


def _pictured(path: Path, content: Mapping[str, object]) -> FloorMap:
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


def _numbers(path: Path, key: str, value: object, shape: tuple[int | None, ...]) -> np.ndarray:
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
