"""Floor maps as TOML files: patches on a base, or a picture with the colours of its surfaces."""

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, FiniteFloat

from slipid.data.floor_map import MOST_CELLS, FloorMap, from_picture, from_polygons
from slipid.support.errors import DataError
from slipid.support.files import write_bytes
from slipid.support.toml_file import Section, checked, mapping_of, text_of

SCHEMA = "slipid.map/1"
Point = tuple[FiniteFloat, FiniteFloat]
"""x, y [m]."""
Colour = Annotated[str, Field(pattern="^#[0-9a-fA-F]{6}$")]


class Patch(Section):
    """Where a surface covers the base."""

    surface: str
    polygon: list[Point] = Field(min_length=3)


class Patched(Section):
    """Patches on a base, later ones on top; `extent_m` is lowest x, y, then highest x, y."""

    schema_: Literal["slipid.map/1"] = Field(alias="schema")
    base: str
    extent_m: tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
    cell_m: float = Field(0.005, gt=0, le=1)
    patch: list[Patch] = Field(default_factory=list)


class Pictured(Section):
    """A picture seen from above, its lower left corner at `corner_m`."""

    schema_: Literal["slipid.map/1"] = Field(alias="schema")
    picture: str
    colours: dict[str, Colour] = Field(min_length=1)
    metres_per_pixel: float = Field(ge=1e-5, le=1)
    corner_m: Point = (0.0, 0.0)


def read_map(path: Path) -> FloorMap:
    """Map from a TOML file: `base`, `extent_m` and `[[patch]]`, or `picture` and `[colours]`.

    Raises:
        DataError: unreadable, unknown or missing keys, wrong values.
    """
    mapping = mapping_of(path, text_of(path, "a floor map"))
    try:
        if "picture" in mapping:
            return _pictured(path, checked(path, mapping, Pictured))
        given = checked(path, mapping, Patched)
        x0, y0, x1, y1 = given.extent_m
        if not (x0 < x1 and y0 < y1):
            raise DataError(
                f"{path}: extent_m {given.extent_m}; expected lowest x, y, then highest x, y"
            )
        patches = [(patch.surface, patch.polygon) for patch in given.patch]
        return from_polygons(given.base, patches, given.extent_m, given.cell_m)
    except DataError:
        raise
    except ValueError as error:
        raise DataError(f"{path}: {error}") from error


def write_map(path: Path, floor: FloorMap, colours: Mapping[str, str]) -> None:
    """Write a map as a TOML file and a picture of its name beside it, in these colours `#rrggbb`.

    Raises:
        ValueError: two surfaces have one colour.
        DataError: nothing can be written there.
    """
    from matplotlib.colors import to_rgb
    from matplotlib.image import imsave

    table = np.array([to_rgb(colours[name]) for name in floor.surfaces])
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


def _pictured(path: Path, given: Pictured) -> FloorMap:
    from matplotlib.image import imread

    source = path.parent / given.picture
    try:
        picture = np.asarray(imread(source), float)
    except (OSError, ValueError, SyntaxError) as error:
        raise DataError(f"{path}: picture {source}: {error}; expected a PNG or JPEG") from error
    if picture.ndim == 2:  # shades of grey
        picture = np.repeat(picture[..., None], 3, axis=2)
    if picture.shape[0] * picture.shape[1] > MOST_CELLS:
        raise DataError(f"{path}: picture {source}: expected at most {MOST_CELLS} pixels")
    picture = picture[..., :3] if picture.max() <= 1 else picture[..., :3] / 255
    return from_picture(picture, given.colours, given.metres_per_pixel, given.corner_m)
