"""Interpretations of the logs: order and signs of the wheels' columns, and the axes of the poses.

The declared interpretation is compared with candidates, which differ from it by single mistakes.
The misfit of an interpretation is a sum of unexplained fractions, each from 0 to 1. A fraction does
not depend on the length of the motion, so that slip, which shortens the motion, does not count
against the true interpretation. Each compared channel contributes the fraction of its motion that
consists of:

    pose, and commanded twist   body increments along each axis that the wheels do not explain
    wheels                      rotations impossible for a rigid body (with more than three wheels)
    commanded wheel speeds      rotations that the commanded rotations do not explain
    gyro                        heading increments that those of the gyro do not explain
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from slipid.data.check.joined import (
    CONVENTIONS,
    ChannelIncrements,
    PoseConvention,
    Products,
    StepEdges,
    body_motion,
    products,
    rotation,
    usable,
)
from slipid.model.geometry import Geometry

LEAST_MOTION = 1e-3
"""Share of the predicted motion below which an axis is not compared [1]."""
POSSIBLE_SHARE = 0.99
"""Least share of the steps whose headings are possible under a convention, as those above 1 are not
for a sine; with a smaller share the convention is not compared [1]."""


@dataclass(frozen=True)
class Interpretation:
    """One interpretation of the columns, relative to the declared one.

    Attributes:
        order: column of each wheel, counted from 0; empty for the declared order.
        sign: sign of each wheel, relative to the declared sign; empty if all signs are as declared.
        azimuth: correction to the declared directions of all wheels [deg].
        convention: convention of the poses.
        command_order: like `order`, for the commanded wheel speeds.
        command_sign: like `sign`, for the commanded wheel speeds.
        twist_sign: signs of the commanded x, y and yaw rate, relative to the declared signs.
        gyro_sign: sign of the gyro, relative to the declared sign.
    """

    order: tuple[int, ...] = ()
    sign: tuple[int, ...] = ()
    azimuth: int = 0
    convention: PoseConvention = field(default_factory=PoseConvention)
    command_order: tuple[int, ...] = ()
    command_sign: tuple[int, ...] = ()
    twist_sign: tuple[int, int, int] = (1, 1, 1)
    gyro_sign: int = 1


@dataclass(frozen=True, eq=False)
class Commanded:
    """Sums over steps of products of the wheels' measured and commanded turns.

    Attributes:
        across: sums of measured times commanded turns (wheel, wheel) [rad^2].
        turns: sum of squared measured turns [rad^2].
        commanded: sum of squared commanded turns [rad^2].
    """

    across: Float[np.ndarray, "wheel wheel"]
    turns: float
    commanded: float

    def product(self, meant: Interpretation) -> float:
        """Return the sum of measured times commanded turns under an interpretation [rad^2]."""
        wheels = len(self.across)
        command = Interpretation(meant.command_order, meant.command_sign)
        turned = columns(meant, wheels) @ self.across @ columns(command, wheels).T
        return float(np.trace(turned))

    def unexplained(self, meant: Interpretation) -> float:
        """Return the fraction of the turns that commanded turns, times a factor, do not explain."""
        squares = max(self.turns * self.commanded, 1e-300)
        return 1.0 - max(self.product(meant), 0.0) ** 2 / squares


@dataclass(frozen=True, eq=False)
class Evidence:
    """Sums of products from which the misfit of every interpretation is computed.

    Attributes:
        rolling: turns of each wheel per body increment without slip, that is, the Jacobian divided
            by the wheel radius (wheel, 3) [rad/m]; the heading increment is an arc in metres at the
            base radius.
        base: base radius [m].
        pose: products of the turns as declared with the body increments from the poses, for each
            convention without offset under which the logged headings are possible.
        twist: products of the turns as declared with the commanded body increments, or None.
        command: products of the turns as declared with the commanded turns, or None.
        gyro: correlation of gyro and heading for each convention without offset; None if no run
            turns or there is no gyro.
    """

    rolling: Float[np.ndarray, "wheel 3"]
    base: float
    pose: Mapping[PoseConvention, Products]
    twist: Products | None
    command: Commanded | None
    gyro: Mapping[PoseConvention, float] | None

    @property
    def wheels(self) -> int:
        """Return the number of wheels."""
        return len(self.rolling)

    @property
    def free(self) -> bool:
        """Return whether the wheels determine all three components of the twist."""
        return bool(np.linalg.matrix_rank(self.rolling, tol=1e-6) == 3)


def gather(geometry: Geometry, at: StepEdges, moved: ChannelIncrements) -> Evidence:
    """Return the evidence from the channels of all runs, for the declared geometry of the robot."""
    base = float(geometry.base_radius)
    rolling = np.asarray(geometry.forward()) / float(geometry.wheel_radius) / [1.0, 1.0, base]
    pose: dict[PoseConvention, Products] = {}
    gyro: dict[PoseConvention, float] = {}
    known = usable(moved.wheels, body_motion(at, PoseConvention())).sum()
    for convention in CONVENTIONS:
        body = body_motion(at, convention)
        found = products(moved.wheels, body, base)
        if found is None or found.known.sum() < POSSIBLE_SHARE * known:
            continue
        pose[convention] = found
        if moved.gyro is not None:
            gyro[convention] = _correlation_with_gyro(moved.gyro, body, found)
    twist = None if moved.twist is None else products(moved.wheels, moved.twist, base, rounds=0)
    if twist is not None and not np.trace(twist.body) > 0:
        twist = None
    turns = gyro if any(gyro.values()) else None
    return Evidence(rolling, base, pose, twist, _commanded(moved), turns)


def _correlation_with_gyro(gyro: np.ndarray, body: np.ndarray, found: Products) -> float:
    """Return the correlation between the rotations of gyro and heading, 0 if either is constant."""
    turned = np.stack([gyro[found.known, 0], body[found.known, 2]])
    (gyro_square, both), (_, pose_square) = (turned * found.weight) @ turned.T
    size = np.sqrt(gyro_square * pose_square)
    return float(both / size) if size > 0 else 0.0


def _commanded(moved: ChannelIncrements) -> Commanded | None:
    """Return the products of measured and commanded turns, or None if no turns were commanded."""
    if moved.commanded is None:
        return None
    known = usable(moved.wheels, moved.commanded)
    turns, commanded = moved.wheels[known], moved.commanded[known]
    if not (commanded**2).sum() > 0:
        return None
    return Commanded(turns.T @ commanded, float((turns**2).sum()), float((commanded**2).sum()))


def misfits(evidence: Evidence, meant: Interpretation) -> dict[str, float]:
    """Return the unexplained fraction of each compared channel, keyed by the channel's name."""
    convention = meant.convention
    bare = convention.bare
    pose = evidence.pose.get(bare)
    wheels = columns(meant, evidence.wheels)
    predict = to_body(evidence, meant)
    out = {"pose": 1.0}
    if pose is not None:
        out["pose"] = _unexplained(pose, predict, rotation(-convention.offset), evidence.free)
        out["wheels"] = _beyond_rigid(pose, evidence.rolling, wheels)
    if evidence.twist is not None:
        signs = np.diag(np.array(meant.twist_sign, float))
        out["twist"] = _unexplained(evidence.twist, predict, signs, evidence.free)
    if evidence.command is not None:
        out["command"] = evidence.command.unexplained(meant)
    if evidence.gyro is not None:
        out["gyro"] = 0.5 * (1.0 - meant.gyro_sign * evidence.gyro.get(bare, -1.0))
    return out


def columns(meant: Interpretation, wheels: int) -> Float[np.ndarray, "wheel wheel"]:
    """Return the signed permutation matrix that maps the declared columns to the true wheels."""
    order, sign = meant.order or tuple(range(wheels)), meant.sign or (1,) * wheels
    out = np.zeros((wheels, wheels))
    out[np.arange(wheels), list(order)] = sign
    return out


def to_body(evidence: Evidence, meant: Interpretation) -> Float[np.ndarray, "3 wheel"]:
    """Return the matrix from turns, in the declared columns, to body increments without slip.

    Increments are ahead [m], left [m] and of the heading, as an arc at the base radius [m].
    """
    inverse = np.linalg.pinv(evidence.rolling, rcond=1e-6)
    turned = rotation(meant.azimuth) @ inverse
    return np.asarray(turned @ columns(meant, evidence.wheels))


def _unexplained(
    sums: Products,
    predict: Float[np.ndarray, "3 wheel"],
    axes: Float[np.ndarray, "3 3"],
    free: bool,
) -> float:
    """Return the fraction of the body's motion that the prediction does not explain.

    The prediction has a fitted factor for each axis. Translation and rotation are weighted by the
    mean of their fractions of the rms motion in the prediction and in the poses, so that lengths in
    a wrong unit hide neither of them. Fractions of the squared motion would hide the short turns
    between long straight legs. Wheels that do not determine the twist (`free` is False) determine
    only one direction of translation, which has a single factor.

    Args:
        sums: products of turns and body increments.
        predict: matrix from turns to body increments.
        axes: matrix from the axes of the measured body increments to the true ones.
        free: True if the wheels determine all three components of the twist.
    """
    predicted, both = sums.predicted(predict), sums.matched(predict, axes)
    measured = np.diag(axes @ sums.body @ axes.T)
    total = predicted.sum()
    if not total > 0 or not measured.sum() > 0:
        return 1.0
    moves = predicted > LEAST_MOTION * total
    explained = np.where(moves, both.clip(0) ** 2 / np.where(moves, predicted, 1.0), 0.0)
    # If all wheels roll in one direction, a single factor applies to both axes of translation.
    if not free and moves[:2].any():
        explained[:2] = 0.5 * max(both[:2].sum(), 0.0) ** 2 / predicted[:2].sum()
    along = 1.0 - explained[:2].sum() / max(measured[:2].sum(), 1e-300)
    about = 1.0 - explained[2] / max(measured[2], 1e-300)
    share = 0.5 * (_share_of_rotation(predicted) + _share_of_rotation(measured))
    return float((1 - share) * along + share * about)


def _share_of_rotation(squares: Float[np.ndarray, "3"]) -> float:
    """Return the fraction of the rms motion that is rotation, from sums of squares per axis."""
    ahead, about = np.sqrt(np.array([squares[:2].sum(), squares[2]]).clip(0))
    return float(about / (ahead + about))


def _beyond_rigid(
    sums: Products, rolling: Float[np.ndarray, "wheel 3"], wheels: Float[np.ndarray, "wheel wheel"]
) -> float:
    """Return the fraction of wheel rotation that is impossible for a rigid body without slip."""
    basis, values, _ = np.linalg.svd(rolling, full_matrices=False)
    basis = basis[:, values > 1e-6 * values[0]]
    turns = wheels @ sums.turns @ wheels.T
    total = float(np.trace(turns))
    return 1.0 - float(np.trace(basis.T @ turns @ basis)) / total if total > 0 else 0.0
