"""Causal features of what a robot feels: what the last half to two seconds were like.

For every window, of rows that lie in the last so many seconds, the row itself included:

    mean and std of the current and of the speed of each drive
    mean of the summed currents over that of the summed wheel speeds
    mean size of the gyro's yaw rate; mean and std of how much it falls short of the encoders'

and how long the robot has been heard, since windows are shorter at the start. This is what slipid's
filter hears too: wheels, currents, gyro. The vibration comes in only where it is asked for.

A Gaussian per floor over windows: what a practitioner writes in ten lines.

    x ~ N(m_floor, S_floor),   S_floor = (1 - a) (own covariance) + a (that of all floors together)
    log p_t = log p_{t-1} + (dt / apart) log N(x_t; m_floor, S_floor) + const

x are the features of a window, each less its mean over its std; what was not logged of them
counts as the mean. a = 1 is linear discriminant analysis, a = 0 quadratic. Tuned
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
from jaxtyping import Float, Int

from slipid.lab.systems.floors.interface import (
    Beliefs,
    FloorClassifier,
    FloorSignals,
    accumulated,
    floors_of,
    training_rows,
)
from slipid.predict.slip_model import RobotSpec

WINDOWS_S = (0.5, 1.0, 2.0)
"""Lengths of the windows [s]."""


@dataclass(frozen=True)
class FeatureChannels:
    """Which channels features are made of; wheel speeds always.

    Attributes:
        current, gyro, vibration: whether they are heard.
    """

    current: bool = True
    gyro: bool = True
    vibration: bool = False


def features(
    felt: FloorSignals,
    spec: RobotSpec,
    hearing: FeatureChannels = FeatureChannels(),
    windows_s: Sequence[float] = WINDOWS_S,
    piece_s: float = np.inf,
) -> Float[np.ndarray, "row feature"]:
    """Features of every row, by the rows up to it; NaN where nothing was heard of a channel.

    After every `piece_s` [s] what came before is forgotten, as if the run began anew.
    """
    began = felt.began(piece_s)
    columns = [np.minimum(felt.time - felt.time[began], max(windows_s))]
    for seconds in windows_s:
        window = TrailingWindow.of(felt.time, seconds, began)
        columns += [column for x in _moving(felt, hearing) for column in window.both(x)]
        if hearing.current:
            amps, turned = np.abs(felt.current).sum(axis=1), np.abs(felt.speed).sum(axis=1)
            columns.append(window.mean(amps) / (window.mean(turned) + 0.1))
        if hearing.gyro and felt.gyro is not None:
            turn = felt.rolling(spec)[:, 2]
            columns.append(window.mean(np.abs(felt.gyro)))
            columns += window.both(yaw_rate_shortfall(felt.gyro, turn))
        if hearing.vibration and felt.vibration is not None:
            columns += window.both(felt.vibration)
    return np.stack(columns, axis=1)


def yaw_rate_shortfall(
    gyro: Float[np.ndarray, " row"], turn: Float[np.ndarray, " row"]
) -> Float[np.ndarray, " row"]:
    """How much a gyro's yaw rate falls short of the encoders', whichever way they turn [rad/s]."""
    return np.asarray(np.where(turn < 0, gyro - turn, turn - gyro))


def _moving(felt: FloorSignals, hearing: FeatureChannels) -> list[np.ndarray]:
    """Channels of which means and stds are features, one array each."""
    drives = range(felt.speed.shape[1])
    amps = [np.abs(felt.current[:, k]) for k in drives] if hearing.current else []
    return [*amps, *(felt.speed[:, k] for k in drives)]


@dataclass(frozen=True, eq=False)
class TrailingWindow:
    """For every row, those rows of the last so many seconds.

    Attributes:
        first: of the rows in the window of each row.
    """

    first: Int[np.ndarray, " row"]

    @classmethod
    def of(
        cls,
        time: Float[np.ndarray, " row"],
        seconds: float,
        began: Int[np.ndarray, " row"] | None = None,
    ) -> "TrailingWindow":
        """Windows of a length at rows of these times [s], none of them from before `began`."""
        first = np.searchsorted(time, time - seconds + 1e-6)
        return cls(first if began is None else np.maximum(first, began))

    def mean(self, x: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
        """Mean over each window of what is a number; NaN where nothing is."""
        return self.both(x)[0]

    def both(self, x: Float[np.ndarray, " row"]) -> list[Float[np.ndarray, " row"]]:
        """Mean and std over each window of what is a number; NaN where nothing is."""
        known = np.isfinite(x)
        # about the first value, so that squares lose fewer digits
        middle = float(x[known][0]) if known.any() else 0.0
        value = np.where(known, x - middle, 0.0)
        count = self._sum(known.astype(float))
        count = np.where(count > 0, count, np.nan)
        mean = self._sum(value) / count
        variance = self._sum(value**2) / count - mean**2
        return [mean + middle, np.sqrt(np.maximum(variance, 0.0))]

    def _sum(self, x: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
        total = np.append(0.0, np.cumsum(x))
        return np.asarray(total[1:] - total[self.first])


@dataclass(frozen=True, eq=False)
class FloorGaussians:
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
class GaussianClassifier(FloorClassifier):
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
    fitted: FloorGaussians | None = field(default=None, repr=False)

    def candidates(self) -> Sequence["GaussianClassifier"]:
        return [replace(self, shared=shared) for shared in (0.0, 0.3, 1.0)]

    def fit(self, felts: Sequence[FloorSignals], spec: RobotSpec) -> "GaussianClassifier":
        labels = floors_of(felts)
        rows, floor = training_rows(felts, lambda felt: self._features(felt, spec, self.piece_s))
        middle, scale = np.nanmean(rows, axis=0), np.nanstd(rows, axis=0)
        comparable = np.nan_to_num((rows - middle) / np.maximum(scale, 1e-9), nan=0.0)
        groups = [comparable[floor == name] for name in labels]
        mean = np.stack([group.mean(axis=0) for group in groups])
        own = np.stack([np.cov(group.T, bias=True) for group in groups])
        covariance = (1 - self.shared) * own + self.shared * own.mean(axis=0)
        factor = np.linalg.cholesky(covariance + self.ridge * np.eye(len(middle)))
        cloud = FloorGaussians(
            middle=middle,
            scale=np.maximum(scale, 1e-9),
            mean=mean,
            root=np.linalg.inv(factor),
            log_volume=np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1),
        )
        return replace(self, labels=labels, fitted=cloud)

    def probability(self, felts: Sequence[FloorSignals], spec: RobotSpec) -> list[Beliefs]:
        if self.fitted is None:
            raise ValueError(f"{self.name} was not fitted")
        return [
            accumulated(self.fitted.log_likelihood(self._features(felt, spec)), felt, self.apart_s)
            for felt in felts
        ]

    @property
    def numbers(self) -> int:
        if self.fitted is None:
            return 0
        floors, count = self.fitted.mean.shape
        return floors * (count + count * (count + 1) // 2)

    def _features(
        self, felt: FloorSignals, spec: RobotSpec, piece_s: float = np.inf
    ) -> Float[np.ndarray, "row feature"]:
        """Those of one window, without the time heard."""
        return features(felt, spec, FeatureChannels(), (self.window_s,), piece_s)[:, 1:]
