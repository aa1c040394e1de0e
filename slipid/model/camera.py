"""Camera model: from the body's pose on the floor to the logged pose of its marker."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from slipid.parameter import known

plane = partial(known, of="axis")
"""Declaration of a vector (x, y) in the plane that stays fixed unless the user frees it."""


class Camera(eqx.Module):
    """Map from the body's pose on the floor to the logged pose of its marker.

    Logged positions are corrected by `corrected`: true = scale * Q(q), with q measured from the
    image centre and Q(q) = (q (1 + k q.q) + p q.q + 2 q (p.q)) / (1 + tilt.q): perspective of a
    tilted camera, radial and tangential distortion (Brown 1966, Conrady 1919; first order of each).
    The marker's heading is the body's plus `marker_yaw`, plus a deviation for each session, since
    the marker may have been mounted again.
    """

    scale: Array = known("1", "s", "true over logged length", start=1.0, lower=0.0, spread=0.02)
    lag: Array = known("s", "t_c", "camera behind the encoders", start=0.0, spread=0.03)
    marker_yaw: Array = known("rad", "psi", "marker heading less body's", start=0.0, spread=0.03)
    session_yaw: Array = known(
        "rad",
        "dpsi",
        "deviation of the marker heading in a session",
        start=0.0,
        spread=0.01,
        per="sessions",
    )
    marker_place: Array = plane("m", "p_m", "marker from the body's centre", start=0.0, spread=0.02)
    tilt: Array = plane("1/m", "h", "perspective of a tilted camera", start=0.0, spread=0.03)
    radial: Array = known("1/m^2", "k", "radial distortion", start=0.0, spread=0.02)
    tangential: Array = plane("1/m", "p", "decentred lens", start=0.0, spread=0.02)
    centre: tuple[float, float] = eqx.field(static=True, default=(0.0, 0.0))
    sessions: tuple[str, ...] = eqx.field(static=True, default=())

    def corrected(self, pose: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return a logged pose, corrected for the scale and the distortion of the camera.

        The position is in true metres. The heading is rotated as the map of positions rotates a
        direction there, and is still that of the marker: the marker yaw is not subtracted.
        """
        u = jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])
        place, turned = jax.jvp(self._ground, (pose[:2],), (u,))
        turn = jnp.arctan2(u[0] * turned[1] - u[1] * turned[0], u @ turned)
        return jnp.concatenate([place, (pose[2] + turn)[None]])

    def logged(self, pose: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the logged pose of a true pose: the inverse of `corrected`, by iteration.

        Every iteration multiplies the error by the relative nonlinearity of the map, a few percent
        across an image.
        """
        step = jnp.stack([self.scale, self.scale, jnp.ones(())])
        q = (pose / step).at[:2].add(jnp.asarray(self.centre))
        for _ in range(12):
            q = q + (pose - self.corrected(q)) / step
        return q

    def log_jacobian(self, pose: Float[Array, "3"]) -> Float[Array, ""]:
        """Return log |d corrected / d pose|, which a density of logged poses needs.

        With m the derivative of the map of positions and u the direction of the heading, the
        position contributes log |m| and the heading log(|m| / |m u|^2).
        """
        m = jax.jacfwd(self._ground)(pose[:2])
        turned = m @ jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])
        area = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
        return 2 * jnp.log(area) - jnp.log(turned @ turned)

    def _ground(self, place: Float[Array, "2"]) -> Float[Array, "2"]:
        """Return the true position on the floor of a logged position."""
        q = place - jnp.asarray(self.centre)
        p, r2 = self.tangential, q @ q
        bent = q * (1 + self.radial * r2) + p * r2 + 2 * q * (p @ q)
        return self.scale * bent / (1 + self.tilt @ q)

    def yaw(self, session: Int[Array, ""] | int) -> Float[Array, ""]:
        """Return the marker's heading less the body's [rad] in a session.

        In session -1, which stands for any session that was not fitted, the deviation is zero.
        """
        if not self.sessions:
            return self.marker_yaw
        own = jnp.where(session >= 0, self.session_yaw[session], 0.0)
        return self.marker_yaw + own

    def marker_increment(
        self, increment: Float[Array, "3"], session: Int[Array, ""] | int
    ) -> Float[Array, "3"]:
        """Return the marker's body-frame increment for a body increment (x, y [m], yaw [rad])."""
        c, s = jnp.cos(increment[2]), jnp.sin(increment[2])
        px, py = self.marker_place[0], self.marker_place[1]
        x = increment[0] + (c - 1) * px - s * py
        y = increment[1] + s * px + (c - 1) * py
        psi = self.yaw(session)
        c, s = jnp.cos(psi), jnp.sin(psi)
        return jnp.stack([c * x + s * y, c * y - s * x, increment[2]])
