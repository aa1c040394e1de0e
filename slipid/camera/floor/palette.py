"""The config of a map: surfaces by colour or by marked points, the region, and masks on it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field, model_validator

from slipid.data.floor_map import Colour, Point
from slipid.support.errors import DataError
from slipid.support.toml_file import Section, checked, mapping_of, text_of

SCHEMA: Literal["slipid.palette/1"] = "slipid.palette/1"
Points = Annotated[list[Point], Field(min_length=1)]
Name = Annotated[str, Field(min_length=1, max_length=60)]


class Places(Section):
    """Places in pixels of the picture or in metres of the floor."""

    at_px: Points | None = None
    at_m: Points | None = None

    @model_validator(mode="after")
    def _one(self) -> "Places":
        if (self.at_px is None) == (self.at_m is None):
            raise ValueError("expected either at_px or at_m: [[x, y], ...]")
        return self


class Polygon(Places):
    """A polygon, by its corners."""

    @model_validator(mode="after")
    def _corners(self) -> "Polygon":
        if (count := len(self.at_px or self.at_m or [])) < 3:
            raise ValueError(f"{count} corners; expected a polygon of 3 or more")
        return self


class Marked(Places):
    """Points on a surface."""

    surface: Name


class Palette(Section):
    """The user's knowledge of a floor: colours or points of its surfaces, region and masks."""

    schema_: Literal["slipid.palette/1"] = Field(alias="schema")
    palette: dict[Name, Colour] = Field(default_factory=dict)
    points: list[Marked] = Field(default_factory=list)
    region: Polygon | None = None
    mask: list[Polygon] = Field(default_factory=list)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the surfaces, in the order of the config."""
        return tuple(dict.fromkeys([*self.palette, *(one.surface for one in self.points)]))


def read_palette(path: Path) -> Palette:
    """Return the config in a TOML file, checked.

    Raises:
        DataError: unreadable, unknown or missing keys, wrong values, two surfaces of one colour.
    """
    palette = checked(path, mapping_of(path, text_of(path, "a palette of surfaces")), Palette)
    first: dict[str, str] = {}
    for name, colour in palette.palette.items():
        same = first.setdefault(colour.lower(), name)
        if same != name:
            raise DataError(
                f"{path}: palette.{name}: '{colour}', the colour of {same}; expected another: "
                "surfaces are distinguished by it"
            )
    return palette


def palette_text(surfaces: Sequence[str], image: str, before: Palette) -> str:
    """Return a config that finds the same surfaces again, to be edited.

    Args:
        surfaces: tables of the proposed surfaces, see `points_text`.
        image: name of the picture.
        before: config without surfaces, whose region and masks are kept.
    """
    lines = [
        f"# Surfaces that `slipid map` proposed for {image}.",
        "# Rename them. Two with the same name become one surface: where the light differs much,",
        "# one surface is often proposed as two. If a surface is missing, add points on it.",
        "# Then: slipid map IMAGE --config this file, with the other options as before.",
        f'schema = "{SCHEMA}"',
        "",
    ]
    lines += _polygon("[region]", before.region) if before.region else _EXAMPLE
    for one in before.mask:
        lines += _polygon("[[mask]]", one)
    return "\n".join([*lines, *surfaces])


def points_text(name: str, colour: str, share: float, pixels: Float[np.ndarray, "point 2"]) -> str:
    """Return the table of a surface that is marked by points.

    Args:
        name: name for the surface.
        colour: its colour `#rrggbb`, for a comment.
        share: part of the mapped floor that it covers [1], for a comment.
        pixels: points on it.
    """
    points = ", ".join(f"[{x:.0f}, {y:.0f}]" for x, y in pixels.tolist())
    return (
        f"[[points]]  # {colour}, {100 * share:.1f} % of the mapped floor\n"
        f'surface = "{name}"\nat_px = [{points}]\n'
    )


_EXAMPLE = [
    "# Only the floor in a region is mapped; objects on the floor can be masked:",
    "# [region]",
    "# at_px = [[100, 100], [900, 100], [900, 700], [100, 700]]",
    "# [[mask]]",
    "# at_px = [[10, 10], [60, 10], [60, 80]]",
    "",
]


def _polygon(head: str, polygon: Polygon) -> list[str]:
    key, corners = ("at_px", polygon.at_px) if polygon.at_px else ("at_m", polygon.at_m)
    return [head, f"{key} = {[list(corner) for corner in corners or []]}", ""]
