"""Colours of an image, and the illumination of the floor in it.

Colours have two forms here: linear RGB, in which light is additive, and CIELAB, in which distances
correspond to differences that people perceive. A surface of colour c appears at a position x in the
image as gain(x) c + veil(x) in linear RGB. The gain is due to shading and to the lens, whose image
is darker at the edges; the veil is light that the floor mirrors or the lens scatters. Gain and veil
change slowly over the floor.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, UInt8

from slipid.camera.opencv import cv2

DEGREE = 4
"""Highest total degree in x and y of the polynomials that describe gain and veil."""
STIFF_GAIN, STIFF_VEIL = 3e-4, 1e-3
"""Weights of the penalties on the gain's deviation from 1 and on the veil, relative to the weighted
mean square misfit of colours [1]."""
ALTERNATIONS = 6
"""Number of iterations in which illumination and colours are fitted alternately."""
DARK = 0.03
"""Linear RGB value up to which noise is about constant; above it noise grows with the value [1]."""


@dataclass(frozen=True, eq=False)
class Features:
    """Features of every cell by which surfaces are distinguished.

    Attributes:
        appearance: lightness L, a and b of CIELAB, and texture (see `texture`).
        rgb: linear red, green and blue, 0 to 1.
    """

    appearance: Float[np.ndarray, "row column 4"]
    rgb: Float[np.ndarray, "row column 3"]


def features_of(colour: UInt8[np.ndarray, "row column 3"], smooth: float = 1.0) -> Features:
    """Return the features of cells whose colours are given in blue, green, red.

    Args:
        colour: colours of the cells.
        smooth: width sigma of the Gaussian kernel that smooths the colours' noise [cells].
    """
    fine = colour.astype(np.float32) / 255
    soft = cv2.GaussianBlur(fine, (0, 0), smooth)
    lab = cv2.cvtColor(soft, cv2.COLOR_BGR2LAB)
    rough = texture(cv2.cvtColor(fine, cv2.COLOR_BGR2LAB)[..., 0])
    return Features(np.concatenate([lab, rough[..., None]], axis=-1), to_linear(soft[..., ::-1]))


def texture(lightness: Float[np.ndarray, "row column"]) -> Float[np.ndarray, "row column"]:
    """Return log(1 + v), where v is the variation of the lightness within a few cells.

    v is a median over a window of 13 x 13 cells, so that an edge between surfaces, which is only a
    thin line in the window, does not affect v.
    """
    change = np.abs(lightness - cv2.GaussianBlur(lightness, (0, 0), 2.5))
    coarse = np.clip(change * 16, 0, 255).astype(np.uint8)
    typical = cv2.medianBlur(coarse, 13).astype(np.float32) / 16
    return np.log1p(cv2.GaussianBlur(typical, (0, 0), 3.0))


def to_linear(rgb: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Return the linear RGB values of sRGB values, both from 0 to 1."""
    low = rgb / np.asarray(12.92, rgb.dtype)
    high = ((np.maximum(rgb, 0) + 0.055) / 1.055) ** 2.4
    return np.where(rgb <= 0.04045, low, high).astype(rgb.dtype)


def to_srgb(rgb: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Return the sRGB values of linear RGB values, both from 0 to 1."""
    inside = np.clip(rgb, 0, 1)
    low, high = 12.92 * inside, 1.055 * inside ** (1 / 2.4) - 0.055
    return np.where(inside <= 0.0031308, low, high)


def lab_of(rgb: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Return the CIELAB values of linear RGB values from 0 to 1."""
    bgr = to_srgb(rgb)[..., ::-1].astype(np.float32).reshape(-1, 1, 3)
    if not len(bgr):
        return np.zeros(rgb.shape)
    lab = cv2.cvtColor(np.ascontiguousarray(bgr), cv2.COLOR_BGR2LAB)
    return np.asarray(lab, float).reshape(rgb.shape)


def linear_of_code(code: str) -> Float[np.ndarray, "3"]:
    """Return the linear RGB of a colour `#rrggbb`."""
    return to_linear(np.array([int(code[k : k + 2], 16) for k in (1, 3, 5)]) / 255)


def code_of_linear(rgb: Float[np.ndarray, "3"]) -> str:
    """Return the colour `#rrggbb` of linear RGB."""
    return "#" + "".join(f"{round(255 * float(v)):02x}" for v in to_srgb(rgb))


@dataclass(frozen=True, eq=False)
class Illumination:
    """Gain and veil over the floor, as coefficients of the functions in `basis_at`.

    Attributes:
        gain: coefficients of the gain less 1.
        veil: coefficients of the veil in red, green and blue.
    """

    gain: Float[np.ndarray, " function"]
    veil: Float[np.ndarray, "function 3"]

    @classmethod
    def uniform(cls) -> "Illumination":
        """Return the illumination that is the same everywhere: a gain of 1 and no veil."""
        count = len(_powers()) - 1
        return cls(np.zeros(count), np.zeros((count, 3)))

    def rgb_of(
        self, colours: Float[np.ndarray, "surface 3"], at: Float[np.ndarray, "place 2"]
    ) -> Float[np.ndarray, "surface place 3"]:
        """Return the linear RGB in which surfaces appear at positions x, y from -1 to 1."""
        basis = basis_at(at)
        gain, veil = 1 + basis @ self.gain, basis @ self.veil
        return np.maximum(gain[:, None] * colours[:, None, :] + veil, 1e-4)

    def true_colours(
        self, rgb: Float[np.ndarray, "place 3"], at: Float[np.ndarray, "place 2"]
    ) -> Float[np.ndarray, "place 3"]:
        """Return the surface colours that appear as `rgb` at positions: inverse of `rgb_of`."""
        basis = basis_at(at)
        gain = np.maximum(1 + basis @ self.gain, 0.1)
        return np.clip((rgb - basis @ self.veil) / gain[:, None], 1e-4, 1)


@dataclass(frozen=True, eq=False)
class ColourSamples:
    """Colours of cells whose surface is assumed to be known.

    Attributes:
        at: x and y of each cell, scaled to -1 to 1 over the grid.
        rgb: linear RGB of each cell.
        surface: number of each cell's surface.
        weight: weight of the sample in the fit.
    """

    at: Float[np.ndarray, "place 2"]
    rgb: Float[np.ndarray, "place 3"]
    surface: Int[np.ndarray, " place"]
    weight: Float[np.ndarray, " place"]


@dataclass(frozen=True, eq=False)
class LitColours:
    """Colours of surfaces [linear RGB], and the illumination of the floor."""

    illumination: Illumination
    colours: Float[np.ndarray, "surface 3"]


def fit_illumination(samples: ColourSamples, start: LitColours) -> LitColours:
    """Return the illumination and the surface colours fitted robustly to samples.

    A surface without a sample keeps its colour in `start`.
    """
    fit = start
    basis = basis_at(samples.at)
    for _ in range(ALTERNATIONS):
        weights = _weights(samples, fit)
        fit = replace(fit, illumination=_illumination(samples, basis, fit.colours, weights))
        fit = replace(fit, colours=_colours(samples, basis, fit, weights))
    return fit


def basis_at(at: Float[np.ndarray, "place 2"]) -> Float[np.ndarray, "place function"]:
    """Return products of Legendre polynomials in x and y, of total degree 1 to `DEGREE`."""
    inside = np.clip(at, -1, 1)
    x, y = (np.polynomial.legendre.legvander(inside[:, k], DEGREE) for k in (0, 1))
    return np.stack([x[:, i] * y[:, j] for i, j in _powers()[1:]], axis=1)


def _powers() -> list[tuple[int, int]]:
    """Return the degrees in x and y of the polynomials of `basis_at`, the constant first."""
    return [(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]


def _weights(samples: ColourSamples, fit: LitColours) -> Float[np.ndarray, "place 3"]:
    """Return the weight of each sample and channel.

    Weights are lower for bright colours, whose noise is larger, and for samples with large errors.
    """
    expected = fit.illumination.rgb_of(fit.colours, samples.at)
    own = expected[samples.surface, np.arange(len(samples.surface))]
    scale = 1 / (DARK + 0.5 * (own + samples.rgb))
    error = np.abs((samples.rgb - own) * scale).max(axis=1)
    typical = max(1.5 * float(np.median(error)), 0.02)
    robust = 1 / (1 + (error / (2 * typical)) ** 2) ** 2
    return scale**2 * (samples.weight * robust / samples.weight.sum())[:, None]


def _illumination(
    samples: ColourSamples,
    basis: Float[np.ndarray, "place function"],
    colours: Float[np.ndarray, "surface 3"],
    weights: Float[np.ndarray, "place 3"],
) -> Illumination:
    """Return gain and veil for given colours, from one least-squares problem for all channels."""
    count = basis.shape[1]
    own = colours[samples.surface]
    rough = np.array([(i + j) ** 2.0 for i, j in _powers()[1:]])
    normal = np.diag(np.concatenate([STIFF_GAIN * rough, *[STIFF_VEIL * rough * 16] * 3]))
    right = np.zeros(4 * count)
    for k in range(3):
        part = np.zeros((len(basis), 4 * count))
        part[:, :count] = basis * own[:, k : k + 1]
        part[:, (k + 1) * count : (k + 2) * count] = basis
        weighted = part * weights[:, k : k + 1]
        normal += weighted.T @ part
        right += weighted.T @ (samples.rgb[:, k] - own[:, k])
    solved = np.linalg.solve(normal, right).reshape(4, count)
    return Illumination(solved[0], solved[1:].T)


def _colours(
    samples: ColourSamples,
    basis: Float[np.ndarray, "place function"],
    fit: LitColours,
    weights: Float[np.ndarray, "place 3"],
) -> Float[np.ndarray, "surface 3"]:
    """Return the surface colours for a given illumination, by weighted least squares."""
    gain = (1 + basis @ fit.illumination.gain)[:, None]
    without_veil = samples.rgb - basis @ fit.illumination.veil
    colours = fit.colours.copy()
    for k in np.unique(samples.surface):
        own = samples.surface == k
        top = (weights[own] * gain[own] * without_veil[own]).sum(axis=0)
        bottom = (weights[own] * gain[own] ** 2).sum(axis=0)
        colours[k] = np.clip(top / np.maximum(bottom, 1e-12), 1e-4, 1)
    return colours
