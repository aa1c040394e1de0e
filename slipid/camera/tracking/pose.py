"""The pose of a body on the floor, with its covariance, from the corners of its markers.

The pixel of every corner determines a ray that meets the plane at the corner's height. On that
plane, a body at x, y [m] with heading theta [rad], whose markers appear s times as large as they
are, has its corner i at

    place_i = (x, y) + R(theta) (middle_i + s own_i)                                         (1)

where middle_i is the middle of the corner's marker in the body's axes [m], own_i the vector from
that middle to the corner [m], and R(theta) the rotation by theta. The fit minimises residuals in
pixels; residuals on the plane are converted to pixels by the local derivative of the point where
the ray meets the plane. The factor s is fitted because the edge between black and white is detected
slightly inside or outside its true position, equally at all corners. s absorbs that error, and
reveals a wrong height of the markers. It does not scale middle_i, which was measured with a ruler.
If the errors of corners are independent, with a std of sigma [pixel], the covariance of
(x, y, theta, s) is sigma^2 (J^T J)^-1, where the matrix J holds the derivatives of the residuals.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from slipid.camera.overhead import OverheadCamera
from slipid.camera.tracking.target import Target

GAUSS_NEWTON_STEPS = 3
"""Number of Gauss-Newton steps; few suffice, since the start is already the least-squares solution
in metres, see `_similarity`."""
PIXEL_STEP = 0.5
"""Step of the numerical derivative of floor coordinates with respect to pixels [pixel]."""


@dataclass(frozen=True, eq=False)
class FittedPoses:
    """Poses of a body in all frames, NaN where too few of its corners were detected.

    Attributes:
        pose: x, y [m], heading [rad] between -pi and pi.
        unit_covariance: covariance of the pose if corners have errors with a std of one pixel, in
            products of [m/pixel, m/pixel, rad/pixel].
        size: apparent size of the markers divided by their true size [1].
        squares: sum of the squared residuals [pixel^2].
        free: degrees of freedom of `squares`: two for each detected corner, less four.
    """

    pose: Float[np.ndarray, "frame 3"]
    unit_covariance: Float[np.ndarray, "frame 3 3"]
    size: Float[np.ndarray, " frame"]
    squares: Float[np.ndarray, " frame"]
    free: Float[np.ndarray, " frame"]


@dataclass(frozen=True, eq=False)
class _Corners:
    """All corners of a target.

    Attributes:
        middle: middle of the corner's marker in the body's axes, x ahead and y left [m].
        own: vector from that middle to the corner [m].
        height: height of the corner above the floor [m].
    """

    middle: Float[np.ndarray, "corner 2"]
    own: Float[np.ndarray, "corner 2"]
    height: Float[np.ndarray, " corner"]

    @classmethod
    def of(cls, target: Target) -> "_Corners":
        corners = np.stack([marker.corners for marker in target.markers])
        middle = np.repeat(corners[..., :2].mean(axis=1), 4, axis=0)
        flat = corners.reshape(-1, 3)
        return cls(middle, flat[:, :2] - middle, flat[:, 2])


def poses_of(
    camera: OverheadCamera, target: Target, corners: Float[np.ndarray, "frame marker 4 2"]
) -> FittedPoses:
    """Return the poses of a body, fitted to the detected corners of its markers.

    Args:
        camera: camera with a calibrated pose above the floor.
        target: the body, with its markers in the order of `corners`.
        corners: x, y of the corners [pixel], NaN where a marker was not detected.
    """
    frames = len(corners)
    body = _Corners.of(target)
    pixels = corners.reshape(frames, len(body.height), 2)
    place, per_pixel = _on_planes(camera, pixels, body.height)
    valid = np.isfinite(place).all(axis=-1) & np.isfinite(per_pixel).all(axis=(-1, -2))
    valid &= valid.sum(axis=1, keepdims=True) >= 3
    some = valid.any(axis=1)
    out = FittedPoses(*(np.full((frames, *shape), np.nan) for shape in ((3,), (3, 3), (), (), ())))
    if not some.any():  # the body appears in no frame
        return out
    place, per_pixel, used = place[some], per_pixel[some], valid[some]
    place = np.where(used[..., None], place, 0.0)
    into_pixels = np.linalg.inv(np.where(used[..., None, None], per_pixel, np.eye(2)))
    fitted = _similarity(place, body.middle + body.own, used)
    for _ in range(GAUSS_NEWTON_STEPS):
        residual, slope = _residuals(fitted, place, into_pixels, body, used)
        normal = np.swapaxes(slope, 1, 2) @ slope
        step = np.linalg.solve(normal, np.swapaxes(slope, 1, 2) @ residual[..., None])
        fitted = fitted - step[..., 0]
    residual, slope = _residuals(fitted, place, into_pixels, body, used)
    out.unit_covariance[some] = np.linalg.inv(np.swapaxes(slope, 1, 2) @ slope)[:, :3, :3]
    heading = np.angle(np.exp(1j * fitted[:, 2]))
    out.pose[some] = np.column_stack([fitted[:, :2], heading])
    out.size[some] = fitted[:, 3]
    out.squares[some], out.free[some] = (residual**2).sum(axis=1), 2.0 * used.sum(axis=1) - 4.0
    return out


def _on_planes(
    camera: OverheadCamera,
    pixels: Float[np.ndarray, "frame corner 2"],
    heights: Float[np.ndarray, " corner"],
) -> tuple[Float[np.ndarray, "frame corner 2"], Float[np.ndarray, "frame corner 2 2"]]:
    """Return x, y of corners at their heights [m], and derivatives w.r.t. pixel u, v [m/pixel]."""
    place = np.full(pixels.shape, np.nan)
    slope = np.full((*pixels.shape, 2), np.nan)
    for height in np.unique(heights):
        at = heights == height
        some, z = pixels[:, at], float(height)
        place[:, at] = camera.on_plane(some, z)
        moved = [
            (camera.on_plane(some + step, z) - camera.on_plane(some - step, z)) / (2 * PIXEL_STEP)
            for step in PIXEL_STEP * np.eye(2)
        ]
        slope[:, at] = np.stack(moved, axis=-1)
    return place, slope


def _similarity(
    place: Float[np.ndarray, "frame corner 2"],
    body: Float[np.ndarray, "corner 2"],
    used: Bool[np.ndarray, "frame corner"],
) -> Float[np.ndarray, "frame 4"]:
    """Return x, y [m], heading [rad] and size [1] by least squares in metres, in closed form.

    The result is a start value for equation (1): here the size scales the whole body.
    """
    weight = used / used.sum(axis=1, keepdims=True)
    z, c = place[..., 0] + 1j * place[..., 1], body[:, 0] + 1j * body[:, 1]
    middle, own = (weight * z).sum(axis=1), (weight * c).sum(axis=1)
    away = c - own[:, None]
    turn = (weight * np.conj(away) * (z - middle[:, None])).sum(axis=1)
    turn = turn / (weight * np.abs(away) ** 2).sum(axis=1)
    origin = middle - turn * own
    return np.column_stack([origin.real, origin.imag, np.angle(turn), np.abs(turn)])


def _residuals(
    fitted: Float[np.ndarray, "frame 4"],
    place: Float[np.ndarray, "frame corner 2"],
    into_pixels: Float[np.ndarray, "frame corner 2 2"],
    body: _Corners,
    used: Bool[np.ndarray, "frame corner"],
) -> tuple[Float[np.ndarray, "frame number"], Float[np.ndarray, "frame number 4"]]:
    """Return residuals (computed by equation (1) less measured) [pixel], and their derivatives.

    Derivatives are with respect to x, y, heading and size. Residuals and derivatives are 0 for
    unused corners.
    """
    own, size = _turned(body.own, fitted[:, 2]), fitted[:, 3, None, None]
    turned = _turned(body.middle, fitted[:, 2]) + size * own
    across = np.stack([-turned[..., 1], turned[..., 0]], axis=-1)
    gap = fitted[:, None, :2] + turned - place
    shift = np.broadcast_to(np.eye(2), (*place.shape[:2], 2, 2))
    slope = np.concatenate([shift, across[..., None], own[..., None]], axis=-1)
    residual = np.where(used[..., None], np.einsum("fcij,fcj->fci", into_pixels, gap), 0.0)
    slope = np.where(used[..., None, None], into_pixels @ slope, 0.0)
    return residual.reshape(len(residual), -1), slope.reshape(len(slope), -1, 4)


def _turned(
    points: Float[np.ndarray, "corner 2"], heading: Float[np.ndarray, " frame"]
) -> Float[np.ndarray, "frame corner 2"]:
    c, s = np.cos(heading)[:, None], np.sin(heading)[:, None]
    x, y = points[:, 0], points[:, 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)
