"""How the floor is lit: a gain and a veil of glare that change slowly over it.

A surface of colour c is seen at x as gain(x) c + veil(x), in amounts of light. The gain is shading
and the darker edge of a lens; the veil is light that the floor mirrors or the lens scatters.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

ORDER = 4
"""Highest power of x and y together in a gain or a veil."""
STIFF_GAIN, STIFF_VEIL = 3e-4, 1e-3
"""How hard a gain is held at 1 and a veil at 0: of a mean square relative misfit of 1."""
ROUNDS = 6
"""Of fitting light and colours in turn."""
GRAY = 0.03
"""Amount of light to which noise is about constant, and above which it grows with the light."""


@dataclass(frozen=True, eq=False)
class Light:
    """How the floor is lit.

    Attributes:
        gain: of every power of the place but the constant.
        veil: the same for red, green and blue.
    """

    gain: Float[np.ndarray, " power"]
    veil: Float[np.ndarray, "power 3"]

    @classmethod
    def even(cls) -> "Light":
        """The same everywhere."""
        count = len(_powers()) - 1
        return cls(np.zeros(count), np.zeros((count, 3)))

    def seen(
        self, colours: Float[np.ndarray, "surface 3"], at: Float[np.ndarray, "place 2"]
    ) -> Float[np.ndarray, "surface place 3"]:
        """What surfaces would look like at places, whose x and y go from -1 to 1."""
        basis = shapes(at)
        gain, veil = 1 + basis @ self.gain, basis @ self.veil
        return np.maximum(gain[:, None] * colours[:, None, :] + veil, 1e-4)

    def undone(
        self, light: Float[np.ndarray, "place 3"], at: Float[np.ndarray, "place 2"]
    ) -> Float[np.ndarray, "place 3"]:
        """The colours that look like this at places."""
        basis = shapes(at)
        gain = np.maximum(1 + basis @ self.gain, 0.1)
        return np.clip((light - basis @ self.veil) / gain[:, None], 1e-4, 1)


@dataclass(frozen=True, eq=False)
class Samples:
    """Places whose surface is taken as known.

    Attributes:
        at: x and y, from -1 to 1.
        light: seen there.
        surface: by number.
        weight: how much each counts.
    """

    at: Float[np.ndarray, "place 2"]
    light: Float[np.ndarray, "place 3"]
    surface: Int[np.ndarray, " place"]
    weight: Float[np.ndarray, " place"]


@dataclass(frozen=True, eq=False)
class Lit:
    """Colours of surfaces under a light."""

    light: Light
    colours: Float[np.ndarray, "surface 3"]


def lit(samples: Samples, start: Lit) -> Lit:
    """Light and colours that explain the samples best, robustly.

    A surface without a sample keeps its colour.
    """
    found = start
    basis = shapes(samples.at)
    for _ in range(ROUNDS):
        weights = _weights(samples, found)
        found = replace(found, light=_light(samples, basis, found.colours, weights))
        found = replace(found, colours=_colours(samples, basis, found, weights))
    return found


def shapes(at: Float[np.ndarray, "place 2"]) -> Float[np.ndarray, "place power"]:
    """Legendre polynomials of x and y up to the order, without the constant."""
    inside = np.clip(at, -1, 1)
    one = [np.polynomial.legendre.legvander(inside[:, k], ORDER) for k in (0, 1)]
    return np.stack([one[0][:, i] * one[1][:, j] for i, j in _powers()[1:]], axis=1)


def _powers() -> list[tuple[int, int]]:
    return [(i, j) for i in range(ORDER + 1) for j in range(ORDER + 1 - i)]


def _weights(samples: Samples, found: Lit) -> Float[np.ndarray, "place 3"]:
    """Of every sample and colour: noise grows with the light, and what fits badly counts little."""
    expected = found.light.seen(found.colours, samples.at)
    mine = expected[samples.surface, np.arange(len(samples.surface))]
    scale = 1 / (GRAY + 0.5 * (mine + samples.light))
    off = np.abs((samples.light - mine) * scale).max(axis=1)
    usual = max(1.5 * float(np.median(off)), 0.02)
    robust = 1 / (1 + (off / (2 * usual)) ** 2) ** 2
    return scale**2 * (samples.weight * robust / samples.weight.sum())[:, None]


def _light(
    samples: Samples,
    basis: Float[np.ndarray, "place power"],
    colours: Float[np.ndarray, "surface 3"],
    weights: Float[np.ndarray, "place 3"],
) -> Light:
    """Gain and veil, given colours: one least-squares problem of all three channels."""
    count = basis.shape[1]
    mine = colours[samples.surface]
    rough = np.array([(i + j) ** 2.0 for i, j in _powers()[1:]])
    normal = np.diag(np.concatenate([STIFF_GAIN * rough, *[STIFF_VEIL * rough * 16] * 3]))
    right = np.zeros(4 * count)
    for k in range(3):
        part = np.zeros((len(basis), 4 * count))
        part[:, :count] = basis * mine[:, k : k + 1]
        part[:, (k + 1) * count : (k + 2) * count] = basis
        weighted = part * weights[:, k : k + 1]
        normal += weighted.T @ part
        right += weighted.T @ (samples.light[:, k] - mine[:, k])
    solved = np.linalg.solve(normal, right).reshape(4, count)
    return Light(solved[0], solved[1:].T)


def _colours(
    samples: Samples,
    basis: Float[np.ndarray, "place power"],
    found: Lit,
    weights: Float[np.ndarray, "place 3"],
) -> Float[np.ndarray, "surface 3"]:
    """Colours, given the light."""
    gain = (1 + basis @ found.light.gain)[:, None]
    seen = samples.light - basis @ found.light.veil
    colours = found.colours.copy()
    for k in np.unique(samples.surface):
        mine = samples.surface == k
        top = (weights[mine] * gain[mine] * seen[mine]).sum(axis=0)
        low = (weights[mine] * gain[mine] ** 2).sum(axis=0)
        colours[k] = np.clip(top / np.maximum(low, 1e-12), 1e-4, 1)
    return colours
