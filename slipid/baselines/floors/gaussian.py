"""A Gaussian per floor over windows: what a practitioner writes in ten lines.

    x ~ N(m_floor, S_floor),   S_floor = (1 - a) (own covariance) + a (that of all floors together)
    log p_t = log p_{t-1} + (dt / apart) log N(x_t; m_floor, S_floor) + const

x are the features of `slipid.baselines.floors.features`, each less its mean over its std; what was
not heard of them counts as the mean. a = 1 is linear discriminant analysis, a = 0 quadratic. Tuned
by cross-validation: a.

Liberties
- No published system is copied. A ridge is added to every covariance, since features overlap.
- Features enter as the mean of the last `window_s` alone: windows inside windows nearly repeat it.

Source: Friedman 1989, Journal of the American Statistical Association 84(405), for the mixture of
the covariances.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from slipid.baselines.floors.features import Hearing, features
from slipid.baselines.floors.interface import (
    Beliefs,
    Felt,
    FloorMethod,
    accumulated,
    floors_of,
    rows_of,
)
from slipid.identify.compare.slip_model import Machine


@dataclass(frozen=True, eq=False)
class Cloud:
    """A Gaussian of every floor.

    Attributes:
        middle, scale: of each feature, by which it is made comparable.
        mean: of each floor; root: inverse of the Cholesky factor of its covariance.
        log_volume: logarithm of the factor's determinant.
    """

    middle: Float[np.ndarray, " feature"]
    scale: Float[np.ndarray, " feature"]
    mean: Float[np.ndarray, "floor feature"]
    root: Float[np.ndarray, "floor feature feature"]
    log_volume: Float[np.ndarray, " floor"]

    def comparable(
        self, rows: Float[np.ndarray, "row feature"]
    ) -> Float[np.ndarray, "row feature"]:
        """Features less their mean over their std; 0 where nothing was heard."""
        return np.asarray(np.nan_to_num((rows - self.middle) / self.scale, nan=0.0))

    def log_likelihood(
        self, rows: Float[np.ndarray, "row feature"]
    ) -> Float[np.ndarray, "row floor"]:
        """Of features on every floor, up to a constant."""
        off = self.comparable(rows)[:, None, :] - self.mean
        white = np.einsum("fab,rfb->rfa", self.root, off)
        return np.asarray(-0.5 * (white**2).sum(axis=2) - self.log_volume)


@dataclass(frozen=True)
class Gaussian(FloorMethod):
    """A Gaussian per floor, the likelihood of windows added up.

    Attributes:
        shared: part of the covariance that floors have in common.
        ridge: added to every covariance of comparable features.
        window_s: length of the windows; apart_s: as of `accumulated`; piece_s: after which
            training runs are heard anew [s].
        fitted: the Gaussians; None before.
    """

    name: str = "gaussian"
    shared: float = 0.5
    ridge: float = 0.02
    window_s: float = 1.0
    apart_s: float = 1.0
    piece_s: float = 8.0
    fitted: Cloud | None = field(default=None, repr=False)

    def candidates(self) -> Sequence["Gaussian"]:
        return [replace(self, shared=shared) for shared in (0.0, 0.3, 1.0)]

    def fit(self, felts: Sequence[Felt], machine: Machine) -> "Gaussian":
        labels = floors_of(felts)
        rows, floor = rows_of(felts, lambda felt: self._features(felt, machine, self.piece_s))
        middle, scale = np.nanmean(rows, axis=0), np.nanstd(rows, axis=0)
        comparable = np.nan_to_num((rows - middle) / np.maximum(scale, 1e-9), nan=0.0)
        groups = [comparable[floor == name] for name in labels]
        mean = np.stack([group.mean(axis=0) for group in groups])
        own = np.stack([np.cov(group.T, bias=True) for group in groups])
        covariance = (1 - self.shared) * own + self.shared * own.mean(axis=0)
        factor = np.linalg.cholesky(covariance + self.ridge * np.eye(len(middle)))
        cloud = Cloud(
            middle=middle,
            scale=np.maximum(scale, 1e-9),
            mean=mean,
            root=np.linalg.inv(factor),
            log_volume=np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1),
        )
        return replace(self, labels=labels, fitted=cloud)

    def probability(self, felts: Sequence[Felt], machine: Machine) -> list[Beliefs]:
        if self.fitted is None:
            raise ValueError(f"{self.name} was not fitted")
        return [
            accumulated(
                self.fitted.log_likelihood(self._features(felt, machine)), felt, self.apart_s
            )
            for felt in felts
        ]

    @property
    def numbers(self) -> int:
        if self.fitted is None:
            return 0
        floors, count = self.fitted.mean.shape
        return floors * (count + count * (count + 1) // 2)

    def _features(
        self, felt: Felt, machine: Machine, piece_s: float = np.inf
    ) -> Float[np.ndarray, "row feature"]:
        """Those of one window, without the time heard."""
        return features(felt, machine, Hearing(), (self.window_s,), piece_s)[:, 1:]
