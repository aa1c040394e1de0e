"""Variance components of the residuals of a segment, and their sum, the covariance.

The residuals of a segment have the covariance

    V = sum_c v_c B_c,   c over: camera position and heading noise, shared by neighbouring windows;
                         process noise along, across and in yaw, growing with distance, per floor;
                         individual effect of the run along, across and in yaw, per floor

with variances v_c and matrices B_c, so that the run effects are marginalised. Runs over several
floors have separate variances, as if they were driven on one more floor. Known variances, such as
the ammeter's noise, are added. The list of components also contains variances that are not part of
V: those of effects that runs share (`slipid.fitting.shared_effects`), and that of the load biases
of floors.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from slipid.data.windows import Windows
from slipid.fitting.likelihood import (
    ROUNDING_VARIANCE,
    Batch,
    ElectricNoise,
    indices,
    voltage_std,
)
from slipid.fitting.multi_floor import MULTI_FLOOR_CURRENT, MULTI_FLOOR_MOTION, MultiFloorRuns
from slipid.model.robot import Robot


class Components(eqx.Module):
    """Covariance terms of one block of residuals, and the variances that multiply them.

    Attributes:
        base: covariance B_c of every segment and component at unit variance.
        which: index of the variance v_c of every segment and component.
        known: known variances of single residuals: rounding, and the ammeter's noise.
        segments: indices of the block's segments among all segments of a problem.
        count: number of residuals of each segment that are used in the likelihood.
    """

    base: Float[Array, "segment component m m"]
    which: Int[Array, "segment component"]
    known: Float[Array, "segment m"]
    segments: Int[Array, " segment"]
    count: Float[Array, " segment"]

    @eqx.filter_jit
    def covariance(
        self, log_variance: Float[Array, " variance"] | Float[np.ndarray, " variance"]
    ) -> Float[Array, "segment m m"]:
        """Return the covariance V of every segment's residuals, known variances included."""
        v, m = jnp.exp(log_variance)[self.which], self.base.shape[-1]
        return jnp.einsum("nc,ncij->nij", v, self.base) + self.known[..., None] * jnp.eye(m)

    @property
    def single(self) -> Float[Array, "segment component m"]:
        """Derivative of each residual's variance with respect to the variance of each component."""
        return jnp.diagonal(self.base, axis1=-2, axis2=-1)


@dataclass(frozen=True)
class Component:
    """One variance component: `process` `along`, `camera` `place`, `current` `window` and so on.

    Attributes:
        kind: source of the noise, such as `process`.
        what: direction or channel, such as `along`.
        floor: floor to which the component belongs, None for all floors.
        unit: unit of its std.
        typical: typical std, the centre of its weak log-normal prior.
    """

    kind: str
    what: str
    floor: str | None
    unit: str
    typical: float

    @property
    def name(self) -> str:
        """Name in tables and files: `camera.place`, `process.<floor>.along`."""
        return ".".join(part for part in (self.kind, self.floor, self.what) if part is not None)


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """All variance components of a problem.

    Attributes:
        components: descriptions of the components, in the order of the vector of variances.
        blocks: covariance terms of each block of residuals, keyed by the name of the block.
    """

    components: tuple[Component, ...]
    blocks: dict[str, Components]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.components)

    @property
    def typical(self) -> Float[np.ndarray, " variance"]:
        return np.array([c.typical for c in self.components])


_MOTION = (
    ("along", "m/sqrt(m)", 0.002),
    ("across", "m/sqrt(m)", 0.002),
    ("yaw", "rad/sqrt(m)", 0.01),
)
_EFFECT = (("along", "m/m", 0.01), ("across", "m/m", 0.01), ("yaw", "rad/m", 0.03))
_MULTI_FLOOR = (
    ("process.along", "m/sqrt(m)", 0.02),
    ("process.across", "m/sqrt(m)", 0.01),
    ("process.yaw", "rad/sqrt(m)", 0.05),
    ("run.along", "m/m", 0.03),
    ("run.across", "m/m", 0.02),
    ("run.yaw", "rad/m", 0.06),
)
SHARED = {"neighbours": 0.5, "session": 0.3}
"""Kinds of effects that runs share, with the ratio of their typical std to that of run effects."""
POOLED = "pooled.load_bias"
"""Name of the component that is the common prior variance of the load biases of all floors."""


def noise(windows: Windows, robot: Robot, multi_floor: MultiFloorRuns | None = None) -> NoiseModel:
    """Return the noise model of windows; distances and directions come from the encoders.

    The segments of `multi_floor`, if given, are indexed after those of `windows`.
    """
    floors = robot.surfaces.labels
    table = [
        Component("camera", "place", None, "m", 0.0005),
        Component("camera", "heading", None, "rad", 0.003),
    ]
    for floor in floors:
        table += [Component("process", what, floor, u, v) for what, u, v in _MOTION]
        table += [Component("run", what, floor, u, v) for what, u, v in _EFFECT]
    several_sessions = [floor for floor in floors if len(sessions_on(windows, floor)) > 1]
    for kind, part in SHARED.items():
        for floor in several_sessions if kind == "session" else floors:
            table += [Component(kind, what, floor, u, part * v) for what, u, v in _EFFECT]
    table.append(Component("pooled", "load_bias", None, "1", 0.05))
    on = indices(robot.surface_index, windows.surface)[:, None]
    blocks = {"motion": _motion_components(windows, robot, 2 + 6 * on)}
    if multi_floor is not None:
        table += _multi_floor_components(multi_floor, robot, len(windows), len(table), blocks)
    if windows.has_current:
        start = len(table)
        for floor in floors:
            table += [Component("current", what, floor, "A", 0.05) for what in ("window", "run")]
        blocks["current"] = _current_components(windows, start + 2 * on)
    if windows.has_current and windows.has_voltage:
        n, m = len(windows), windows.turn.shape[1] * windows.turn.shape[2]
        base = np.broadcast_to(np.eye(m), (n, 1, m, m)).copy()
        unread = windows.voltage_var.reshape(n, -1)
        blocks["voltage"] = _components("voltage", base, np.full((n, 1), len(table)), unread)
        table.append(Component("voltage", "window", None, "V", 0.05))
    return NoiseModel(tuple(table), blocks)


def sessions_on(windows: Windows, floor: str) -> list[str]:
    """Return the sessions in which a floor was driven on, in alphabetical order."""
    pairs = zip(windows.surface, windows.session, strict=True)
    return sorted({session for name, session in pairs if name == floor})


def electric_noise(
    blocks: dict[str, Components],
    log_variance: Float[Array, " variance"] | Float[np.ndarray, " variance"],
    resistance: Array,
) -> ElectricNoise:
    """Return the noise that predicted voltages depend on; a placeholder without logged voltages."""
    if "voltage" not in blocks:
        return ElectricNoise(jnp.ones(()), jnp.ones((1, 1)), resistance)
    current, log_v = blocks["current"], jnp.asarray(log_variance)
    scatter = jnp.einsum("nc,nci->ni", jnp.exp(log_v)[current.which], current.single)
    return ElectricNoise(voltage_std(log_v[-1]), scatter + ROUNDING_VARIANCE["current"], resistance)


def _multi_floor_components(
    multi_floor: MultiFloorRuns,
    robot: Robot,
    segments: int,
    start: int,
    blocks: dict[str, Components],
) -> list[Component]:
    """Return the components of runs over several floors, and add their blocks to `blocks`.

    `segments` is the index of these runs' first segment, `start` that of their first variance.
    """
    w, none = multi_floor.windows, np.zeros((len(multi_floor.windows), 1), int)
    table = [
        Component("crossing", what, None, unit, typical) for what, unit, typical in _MULTI_FLOOR
    ]
    motion = _motion_components(w, robot, none + start)
    blocks[MULTI_FLOOR_MOTION] = _counted(
        motion, np.repeat(multi_floor.counts, 3, axis=1), segments
    )
    if w.has_current:
        current = _current_components(w, none + start + len(table))
        live = np.repeat(multi_floor.counts, w.turn.shape[2], axis=1)
        blocks[MULTI_FLOOR_CURRENT] = _counted(current, live, segments)
        table += [Component("crossing", f"current.{k}", None, "A", 0.05) for k in ("window", "run")]
    return table


def _counted(of: Components, live: Bool[np.ndarray, "segment m"], first: int) -> Components:
    """Return covariances in which unused residuals have variance 1 and no correlation.

    Args:
        live: True for residuals that are used; `MultiFloorBatch.residuals` sets all others to zero.
        first: index of the first segment among all segments of the problem.
    """
    both = live[:, None, :, None] & live[:, None, None, :]
    return Components(
        base=jnp.where(both, of.base, 0.0),
        which=of.which,
        known=jnp.where(live, of.known, 1.0),
        segments=of.segments + first,
        count=jax.device_put(live.sum(axis=1).astype(float)),
    )


def _components(
    block: str, base: np.ndarray, which: np.ndarray, more: np.ndarray | float = 0.0
) -> Components:
    """Return components whose known variances are the rounding of the logs plus `more`.

    Args:
        block: name of the block in `ROUNDING_VARIANCE`.
        base, which: as in `Components`.
        more: further known variances (segment, m).
    """
    n, m = base.shape[0], base.shape[-1]
    return Components(
        base=jax.device_put(base),
        which=jax.device_put(which),
        known=jax.device_put(np.full((n, m), ROUNDING_VARIANCE[block]) + more),
        segments=jax.device_put(np.arange(n)),
        count=jax.device_put(np.full(n, float(m))),
    )


def encoder_increments(
    windows: Windows | Batch, robot: Robot
) -> Float[np.ndarray, "segment window 3"]:
    """Return each window's body-frame increment if no wheel slipped, by encoders [m, m, rad]."""
    j = np.asarray(robot.geometry.pseudo_inverse())
    return np.asarray(windows.turn) * float(robot.geometry.wheel_radius) @ j.T


def travel(windows: Windows | Batch, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance of each window by the encoders, and its direction, see `travelled`."""
    return travelled(encoder_increments(windows, robot), float(robot.geometry.base_radius))


def travelled(
    step: Float[np.ndarray, "segment window 3"], base_radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance of increments (segment, window) [m], and their direction.

    The distance includes the turn in radians times the base radius. The direction is a unit vector
    in the body frame (segment, window, 2); it is (1, 0) if the robot turns on the spot.
    """
    distance = np.linalg.norm(step[..., :2], axis=-1)
    turned = np.abs(step[..., 2]) * base_radius
    direction = step[..., :2] / np.maximum(distance, 1e-9)[..., None]
    return distance + turned, np.where(distance[..., None] > 1e-6, direction, [1.0, 0.0])


def _motion_components(
    windows: Windows, robot: Robot, first: Int[np.ndarray, "segment 1"]
) -> Components:
    """Return the components of motion residuals.

    `first` is the index of the first of the six process and run variances of each segment's floor.
    """
    distance, u = travel(windows, robot)
    n, k = distance.shape
    scale = float(robot.camera.scale)
    place, heading = np.zeros((n, k, 3, k + 1, 2)), np.zeros((n, k, 3, k + 1))
    begin, step = np.eye(k, k + 1), np.eye(k, k + 1, 1) - np.eye(k, k + 1)  # (window, edge)
    c, s = scale * np.cos(windows.pose[:, :-1, 2]), scale * np.sin(windows.pose[:, :-1, 2])
    back = np.stack([c, s, -s, c], -1).reshape(n, k, 2, 2)
    place[:, :, :2] = np.einsum("nkij,ke->nkiej", back, step)
    move = np.einsum("nkij,nkj->nki", back, np.diff(windows.pose[..., :2], axis=1))
    heading[:, :, 0], heading[:, :, 1] = move[..., 1:] * begin, -move[..., :1] * begin
    heading[:, :, 2] = step
    place, heading = place.reshape(n, 3 * k, -1), heading.reshape(n, 3 * k, -1)
    grown = axes(u) * np.sqrt(distance)[None, :, None, :]
    effect = effects(windows, robot).transpose(2, 0, 1)[..., None]
    parts = [place, heading, *grown, *effect]
    base = np.stack([p @ p.transpose(0, 2, 1) for p in parts], axis=1)
    of_floor = first + np.arange(6)
    return _components("motion", base, np.insert(of_floor, 0, [[0], [1]], axis=1))


def axes(u: np.ndarray) -> np.ndarray:
    """Return the residuals that unit motion along, across or in yaw causes in each window.

    The shape is (axis, segment, 3 window, window); the last index is that of the moving window. `u`
    is the unit direction of travel in each window, as `travel` returns it.
    """
    n, k, _ = u.shape
    out = np.zeros((3, n, 3 * k, k))
    for j in range(k):
        out[0, :, 3 * j : 3 * j + 2, j] = u[:, j]
        out[1, :, 3 * j, j], out[1, :, 3 * j + 1, j] = -u[:, j, 1], u[:, j, 0]
        out[2, :, 3 * j + 2, j] = 1.0
    return out


def effects(windows: Windows, robot: Robot) -> Float[np.ndarray, "segment m 3"]:
    """Return the change of a segment's residuals per unit of an effect along, across and in yaw."""
    distance, u = travel(windows, robot)
    return (axes(u) * distance[None, :, None, :]).sum(-1).transpose(1, 2, 0)


def _current_components(windows: Windows, first: Int[np.ndarray, "segment 1"]) -> Components:
    """Return the components of current residuals: of single windows, and common to a run.

    `first` is the index of the first of the two current variances of each segment's floor.
    """
    n, k, w = windows.turn.shape
    same = np.kron(np.ones((k, k)), np.eye(w))
    base = np.broadcast_to(np.stack([np.eye(k * w), same]), (n, 2, k * w, k * w)).copy()
    which = first + np.arange(2)
    return _components("current", base, which, windows.current_var.reshape(n, -1))
