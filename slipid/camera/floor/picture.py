"""From one picture from above to a map of the floor."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int

from slipid.camera.floor.asked import AROUND, Asked, Source, around, asked, seeds
from slipid.camera.floor.colour import UNKNOWN, Features, features, settled, tidy
from slipid.camera.floor.found import FoundMap, Told, made, text_of_proposal
from slipid.camera.floor.grid import Robot
from slipid.camera.floor.palette import SCHEMA, Palette, read_palette
from slipid.camera.floor.proposal import Proposal, matched, proposed
from slipid.camera.floor.surfaces import STRANGE, Seeds, learnt
from slipid.camera.frames.still import still
from slipid.camera.overhead import OverheadCamera
from slipid.support.errors import DataError
from slipid.support.progress import Reporter

NARROW = 7
"""Width of the narrowest patch that is kept [cells]."""


@dataclass(frozen=True)
class Wish:
    """What is asked for.

    Attributes:
        config: a palette; None lets the picture propose one.
        surfaces: how many to propose; None chooses.
        cell: edge of a cell [m]; None takes that of a pixel.
    """

    config: Path | None = None
    surfaces: int | None = None
    robot: Robot = field(default_factory=Robot)
    cell: float | None = None


def map_of(path: Path, camera: OverheadCamera, wish: Wish, report: Reporter) -> FoundMap:
    """The map of a picture.

    Raises:
        DataError: no picture, another resolution than the camera's, or a config that does not fit.
    """
    report.stage("laying the picture onto the floor")
    picture = still(path)
    palette = Palette(schema=SCHEMA) if wish.config is None else read_palette(wish.config)
    source = Source(path, wish.config or path, picture, camera)
    if palette.names and wish.surfaces is not None:
        raise DataError(
            f"{wish.config}: it names {len(palette.names)} surfaces; expected no --surfaces with it"
        )
    ask = asked(source, palette, wish.robot, wish.cell)
    found = features(ask.floor.colour)
    report.stage("telling surfaces apart")
    points = None if palette.names else proposed(found, ask.known, wish.surfaces)
    if points is None:
        start = _by_colour(seeds(source, found, ask, palette), found, ask.known)
    else:
        start = _proposed(points, found, ask)
    names = palette.names or tuple(f"surface_{k + 1}" for k in range(len(start.colours)))
    told = _told(found, ask, start)
    if points is None:
        all_found(source, names, told.labels)
    report.stage("drawing outlines")
    drawn = made(source, ask, found, names, palette, told)
    if points is None:
        return drawn
    return replace(drawn, proposal=text_of_proposal(path, palette, drawn, points))


def _told(found: Features, ask: Asked, start: Seeds) -> Told:
    """The surface of each cell; what looks like none of them is unknown."""
    surfaces = learnt(found, ask.known, start)
    costs = surfaces.costs(found.look)
    strange = np.full((1, *ask.known.shape), STRANGE, np.float32)
    labels = settled(np.concatenate([costs, strange]), ask.known)
    labels = tidy(labels, ask.known, NARROW)
    return Told(np.where(labels == len(costs), UNKNOWN, labels), costs, surfaces)


def _by_colour(start: Seeds, found: Features, known: Bool[np.ndarray, "row column"]) -> Seeds:
    """The same, and marked cells on patches that match surfaces with one marked point or none."""
    count = np.bincount(start.surface, minlength=len(start.colours))
    few = count <= (AROUND + 1) ** 2  # cells around a point
    if not few.any():
        return start
    match = matched(found, known, start.colours)
    new = few[match.surface]
    more = Proposal(match.row[new], match.column[new], match.surface[new])
    cells, own = _around(more, known)
    return replace(
        start,
        row=np.concatenate([start.row, cells[:, 0]]),
        column=np.concatenate([start.column, cells[:, 1]]),
        surface=np.concatenate([start.surface, own]),
    )


def _proposed(points: Proposal, found: Features, ask: Asked) -> Seeds:
    """Marked cells around proposed points."""
    cells, surface = _around(points, ask.known)
    row, column = cells.T
    light = found.light[row, column]
    colours = [np.median(light[surface == k], axis=0) for k in range(surface.max() + 1)]
    return Seeds(np.array(colours, float), row, column, surface)


def _around(
    points: Proposal, known: Bool[np.ndarray, "row column"]
) -> tuple[Int[np.ndarray, "cell 2"], Int[np.ndarray, " cell"]]:
    """Known cells around points, and the surface of each."""
    middles = np.column_stack([points.row, points.column])
    near = [around(one[None], known) for one in middles]
    own = np.repeat(points.surface, [len(one) for one in near])
    return np.concatenate([np.zeros((0, 2), int), *near]), own


def all_found(
    source: Source, names: tuple[str, ...], labels: Int[np.ndarray, "row column"]
) -> None:
    """Refuse a surface of a config that no cell has."""
    lost = [name for k, name in enumerate(names) if not (labels == k).any()]
    if lost:
        raise DataError(
            f"{source.config}: nothing in the picture looks most like {', '.join(lost)}; expected "
            "a colour or points of a surface that is there and differs from the others"
        )
