"""What each surface looks like, learnt together with the light from a few marked places or colours.

In turn: every cell gets the surface it looks like under the light so far; the cells that are told
clearly say what colours, spreads and light there are.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from slipid.camera.floor.colour import Features, lab_of, settled
from slipid.camera.floor.shading import Light, Lit, Samples, lit
from slipid.camera.opencv import opencv

ROUNDS = 10
STEADY = 3e-4
"""Share of cells that change their surface in a round, below which it is the last."""
COARSE = 25_000
"""About so many cells are learnt from."""
SAMPLES = 5_000
"""Largest number of cells that light and colours are fitted to."""
LEAST_SPREAD = np.array([2.0, 1.5, 1.5, 0.25])
MOST_SPREAD = np.array([6.0, 4.0, 4.0, 0.7])
"""Of L, a, b and texture within a surface."""
STRANGE = 60.0
"""A cell that costs more with every surface is of none [squared spreads]."""
CLEAR = 16.0
"""A cell that costs less is of its surface [squared spreads]."""


@dataclass(frozen=True, eq=False)
class Seeds:
    """What is known of surfaces before the picture is looked at.

    Attributes:
        colours: of every surface, in amounts of light.
        row, column: cells that are marked; surface: of each.
    """

    colours: Float[np.ndarray, "surface 3"]
    row: Int[np.ndarray, " seed"]
    column: Int[np.ndarray, " seed"]
    surface: Int[np.ndarray, " seed"]


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What every surface looks like.

    Attributes:
        lit: colours and the light on them.
        texture: of each.
        spread: of L, a, b and texture within each.
    """

    lit: Lit
    texture: Float[np.ndarray, " surface"]
    spread: Float[np.ndarray, "surface 4"]

    def looks(self, shape: tuple[int, int]) -> Float32[np.ndarray, "surface row column 4"]:
        """L, a, b and texture that each would have in every cell."""
        cv2 = opencv()
        rows, columns = min(shape[0], 48), min(shape[1], 48)
        seen = lab_of(self.lit.light.seen(self.lit.colours, places((rows, columns))))
        out = np.empty((len(seen), *shape, 4), np.float32)
        size = (shape[1], shape[0])
        for k, one in enumerate(seen.reshape(-1, rows, columns, 3).astype(np.float32)):
            out[k, ..., :3] = cv2.resize(one, size, interpolation=cv2.INTER_LINEAR)
            out[k, ..., 3] = self.texture[k]
        return out

    def costs(
        self, look: Float[np.ndarray, "row column 4"]
    ) -> Float32[np.ndarray, "surface row column"]:
        """How badly each cell looks like each surface [squared spreads], at most a little strange.

        The spread counts as well: a surface that may look like anything is no good explanation.
        """
        out = np.empty((len(self.spread), *look.shape[:2]), np.float32)
        for k, expected in enumerate(self.looks(look.shape[:2])):
            off = (look - expected) / self.spread[k].astype(np.float32)
            wide = 2 * np.log(self.spread[k] / LEAST_SPREAD).sum()
            rough = np.minimum(off[..., 3] ** 2, 6.0)  # edges and dirt are rough as well
            out[k] = (off[..., :3] ** 2).sum(axis=-1) + rough + wide
        return np.minimum(out, 1.5 * STRANGE)


def places(shape: tuple[int, int]) -> Float[np.ndarray, "place 2"]:
    """X and y of all cells, row by row, from -1 to 1."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    size = np.maximum(np.array([shape[1], shape[0]]) - 1, 1)
    return 2 * np.stack([x.ravel(), y.ravel()], axis=-1) / size - 1


def labelled(
    surfaces: Surfaces,
    look: Float[np.ndarray, "row column 4"],
    known: Bool[np.ndarray, "row column"],
) -> Int[np.ndarray, "row column"]:
    """Surface of each cell; one more than the last is what looks like none of them."""
    costs = surfaces.costs(look)
    strange = np.full((1, *look.shape[:2]), STRANGE, np.float32)
    return settled(np.concatenate([costs, strange]), known)


def learnt(found: Features, known: Bool[np.ndarray, "row column"], seeds: Seeds) -> Surfaces:
    """What surfaces look like in this picture."""
    step = max(1, round(np.sqrt(known.size / COARSE)))
    few, some = thinned(found, step), known[step // 2 :: step, step // 2 :: step]
    shape = few.look.shape[:2]
    at = np.stack([np.minimum(seeds.row // step, shape[0] - 1) * shape[1], seeds.column // step])
    marked = at[0] + np.minimum(at[1], shape[1] - 1)
    surfaces = _start(few, marked, seeds)
    steady = _steady(few.look) & some
    before = np.full(shape, -1)
    for _ in range(ROUNDS):
        labels = labelled(surfaces, few.look, some)
        if np.mean(labels != before) < STEADY:
            break
        before = labels
        costs = np.concatenate([surfaces.costs(few.look), np.full((1, *shape), np.inf)])
        mine = np.take_along_axis(costs, np.maximum(labels, 0)[None], axis=0)[0]
        clear = (mine < CLEAR) & steady & (labels < len(seeds.colours)) & (labels >= 0)
        surfaces = _again(surfaces, few, np.where(clear, labels, -1).ravel(), marked, seeds)
    return surfaces


def thinned(found: Features, step: int) -> Features:
    """Every so many cells, smoothed over them."""
    if step == 1:
        return found
    cv2 = opencv()
    cut = slice(step // 2, None, step)
    look = cv2.GaussianBlur(found.look, (0, 0), 0.4 * step)[cut, cut]
    return Features(look, cv2.GaussianBlur(found.light, (0, 0), 0.4 * step)[cut, cut])


def _steady(look: Float[np.ndarray, "row column 4"]) -> Bool[np.ndarray, "row column"]:
    """Cells whose neighbours look about the same: no edge, whose colours are mixed."""
    cv2 = opencv()
    lab = np.ascontiguousarray(look[..., :3])
    kernel = np.ones((3, 3), np.uint8)
    change = (cv2.dilate(lab, kernel) - cv2.erode(lab, kernel)).max(axis=-1)
    return np.asarray(change < max(8.0, 1.5 * float(np.median(change))))


def _start(few: Features, marked: Int[np.ndarray, " seed"], seeds: Seeds) -> Surfaces:
    """From the seeds alone."""
    begin = Lit(Light.even(), seeds.colours)
    texture = np.full(len(seeds.colours), float(np.median(few.look[..., 3])))
    spread = np.tile(MOST_SPREAD, (len(seeds.colours), 1))
    if not len(marked):
        spread[:, 3] = 100.0  # colours say nothing of texture
        return Surfaces(begin, texture, spread)
    light, rough = few.light.reshape(-1, 3)[marked].astype(float), few.look[..., 3].ravel()[marked]
    at = places(few.look.shape[:2])[marked]
    found = lit(Samples(at, light, seeds.surface, np.ones(len(at))), begin)
    for k in np.unique(seeds.surface):
        texture[k] = np.median(rough[seeds.surface == k])
    spread[:, 3] = np.where(np.isin(np.arange(len(spread)), seeds.surface), spread[:, 3], 100.0)
    return Surfaces(found, texture, spread)


def _again(
    surfaces: Surfaces,
    few: Features,
    labels: Int[np.ndarray, " cell"],
    marked: Int[np.ndarray, " seed"],
    seeds: Seeds,
) -> Surfaces:
    """Colours, spreads and light from cells with a label, and from the marked ones."""
    cells = np.flatnonzero(labels >= 0)
    cells = cells[:: 1 + len(cells) // SAMPLES]
    if not len(cells):
        return surfaces
    own = np.concatenate([labels[cells], seeds.surface])
    cells = np.concatenate([cells, marked])
    count = np.bincount(own, minlength=len(seeds.colours))
    # every surface has a say in the light, however small it is
    weight = 1 / np.sqrt(count[own])
    weight[len(weight) - len(marked) :] *= 3
    at = places(few.look.shape[:2])[cells]
    samples = Samples(at, few.light.reshape(-1, 3)[cells].astype(float), own, weight)
    found = replace(surfaces, lit=lit(samples, surfaces.lit))
    return _spread(found, few, cells, own)


def _spread(
    surfaces: Surfaces,
    few: Features,
    cells: Int[np.ndarray, " cell"],
    own: Int[np.ndarray, " cell"],
) -> Surfaces:
    """Texture and spreads around what is expected, robustly."""
    look = few.look.reshape(-1, 4)[cells]
    at = places(few.look.shape[:2])[cells]
    texture, spread = surfaces.texture.copy(), surfaces.spread.copy()
    for k in np.unique(own):
        mine = own == k
        texture[k] = np.median(look[mine, 3])
        expected = lab_of(surfaces.lit.light.seen(surfaces.lit.colours[k : k + 1], at[mine])[0])
        off = np.abs(look[mine] - np.column_stack([expected, np.full(mine.sum(), texture[k])]))
        spread[k] = np.clip(1.5 * np.median(off, axis=0), LEAST_SPREAD, MOST_SPREAD)
    return replace(surfaces, texture=texture, spread=spread)
