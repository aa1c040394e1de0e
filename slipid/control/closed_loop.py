"""A controller, an estimator and a plant in a loop, and what became of the path."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.control.controller import GAINS, Controller
from slipid.control.reference import STEP, Path
from slipid.model.plant import Plant

PREVIEW = GAINS.index("preview")
PERIOD = 0.05
"""Between commands [s]."""
LONGEST = 2.0
"""Times the path's own duration after which a run is given up."""


class Pilot(eqx.Module):
    """An estimator and a controller as one pure function, the state one flat array.

    Attributes:
        observer: an `Estimator`, or anything with its interface.
        controller: a controller.
    """

    observer: Any
    controller: Controller

    def init(self, pose: Any) -> Float[Array, " state"]:
        """State of a robot at rest at a pose; the path's time is the last number."""
        return jnp.concatenate(
            [self.observer.init(jnp.asarray(pose)), self.controller.init(), jnp.zeros(1)]
        )

    def step(
        self,
        path: Path,
        state: Float[Array, " state"],
        measurement: Float[Array, " sensed"],
        dt: Any,
    ) -> tuple[Float[Array, " state"], Float[Array, " out"]]:
        """Next state, and command, estimate and time of the path in one array."""
        cut = self.controller.init().shape[0]
        seen, held, time = state[: -cut - 1], state[-cut - 1 : -1], state[-1]
        seen, estimate = self.observer.step(seen, measurement, dt)
        pose = self.controller.estimated.of(estimate).pose
        here, preview = jnp.where(jnp.isfinite(pose), pose, 1e3), self.controller.gains[PREVIEW]
        time, reference = path.follow(time, here, dt, preview)
        held, command = self.controller.step(held, reference, estimate, dt)
        return (
            jnp.concatenate([seen, held, time[None]]),
            jnp.concatenate([command, estimate, time[None]]),
        )


@dataclass(frozen=True, eq=False)
class Course:
    """One closed-loop run, a row per period.

    Attributes:
        path: what was asked.
        time: [s]; own: time of the path [s].
        pose, believed: true and estimated [m, m, rad].
        command: wheel speeds [rad/s].
        estimate: as the estimator laid it out.
        energy: of the motors until then [J]; NaN where the plant does not know.
    """

    path: Path
    time: Float[np.ndarray, " step"]
    own: Float[np.ndarray, " step"]
    pose: Float[np.ndarray, "step 3"]
    believed: Float[np.ndarray, "step 3"]
    command: Float[np.ndarray, "step wheel"]
    estimate: Float[np.ndarray, "step estimated"]
    energy: Float[np.ndarray, " step"]


def compiled(pilot: Pilot, path: Path) -> Callable[[Any, Any, float], tuple[Any, Any]]:
    """A pilot's step on numpy arrays, cheapest to call: (state, measurement, dt) to both arrays.

    The robot's numbers and the path become constants of the compiled code, and one flat array goes
    in and one comes out; handing over the pilot's leaves at every call costs 100 us. Where
    `jax_cpu_enable_async_dispatch` is off before JAX starts, nothing waits for another thread
    (8 us less, more on a busy machine).

    Args:
        pilot: estimator and controller.
        path: as it lies for the start.
    """
    state = np.asarray(pilot.init(jnp.zeros(3)))
    size, last = len(state), len(state) + pilot.observer.sensed.size
    given = np.zeros(last + 1, state.dtype)

    def step(flat: Array) -> Array:
        return jnp.concatenate(pilot.step(path, flat[:size], flat[size:last], flat[last]))

    run = jax.jit(step)

    def call(state: Any, measurement: Any, dt: float) -> tuple[Any, Any]:
        given[:size], given[size:last], given[last] = state, measurement, dt
        both = np.asarray(run(given))
        return both[:size], both[size:]

    return call


@eqx.filter_jit
def _step(pilot: Pilot, path: Path, state: Array, measurement: Array, dt: Any) -> Any:
    """The step with its numbers as arguments: compiled once for all pilots and starts alike."""
    return pilot.step(path, state, measurement, dt)


def drive(pilot: Pilot, path: Path, plant: Plant, start: Any, period: float = PERIOD) -> Course:
    """Run a pilot on a plant until its path is over.

    Args:
        pilot: estimator and controller.
        path: as it lies for the start.
        plant: what is driven, at rest.
        start: where the pilot believes it stands [m, m, rad].
        period: of the plant [s].
    """
    state, reading, dt = pilot.init(start), plant.reset(), jnp.asarray(period)
    rows: list[np.ndarray] = []
    energy, own, begun = 0.0, 0.0, 0.0
    wheels = pilot.controller.frozen.wheels
    while own < path.duration - 1e-6 and begun < LONGEST * path.duration + 10.0:
        state, out = _step(pilot, path, state, jnp.asarray(reading), dt)
        said = np.asarray(out)
        own = float(said[-1])
        command = said[:wheels]
        rows.append(np.concatenate([[begun, energy], plant.pose, said]))
        reading = plant.step(command)
        energy += getattr(plant, "power", np.nan) * period
        begun += period
    a = np.array(rows)
    heading = np.unwrap(a[:, 4])
    estimate = a[:, 5 + wheels : -1]
    believed = np.asarray(jax.vmap(lambda e: pilot.controller.estimated.of(e).pose)(estimate))
    return Course(
        path=path,
        time=a[:, 0],
        own=a[:, -1],
        pose=np.column_stack([a[:, 2:4], heading]),
        believed=believed,
        command=a[:, 5 : 5 + wheels],
        estimate=estimate,
        energy=a[:, 1],
    )


def _from_line(
    places: Float[np.ndarray, "step 2"], line: Float[np.ndarray, "point 2"]
) -> Float[np.ndarray, " step"]:
    """Distance of places from a line through points [m]."""
    begin, side = line[:-1], np.diff(line, axis=0)
    square = np.maximum((side**2).sum(-1), 1e-18)
    since = places[:, None] - begin
    part = np.clip((since * side).sum(-1) / square, 0.0, 1.0)
    nearest: np.ndarray = np.sqrt(((since - part[..., None] * side) ** 2).sum(-1)).min(1)
    return nearest


def metrics(course: Course) -> dict[str, Any]:
    """What became of a path, from true poses.

    along_track_mm: travelled less wanted at the end of every side; closure_mm: from the end to
    where it should be, and what was left of the way where the run was given up;
    cross_track_rmse_mm: distance from the path as a line, over time; heading_error_deg: at the end;
    path_length_mm: the 2021 paper's metric; energy_j; effort: rms of the change of wheel
    speed commands [rad/s].
    """
    p, path = course.pose, course.path
    corners = np.vstack([np.asarray(path.rows[0, :2]), np.asarray(path.corners)])
    along = []
    for k, mark in enumerate(np.asarray(path.marks)):
        at = min(int(np.searchsorted(course.own, mark - 1e-6)), len(p) - 1)
        side = corners[k + 1] - corners[k]
        size = np.hypot(*side)
        u = side / size if size > 1e-9 else np.zeros(2)
        along.append(1000 * float((p[at, :2] - corners[k + 1]) @ u))
    rows = np.asarray(path.rows[:, :2])
    near = _from_line(p[:, :2], rows[::5] if len(rows) > 5 else rows)
    left = rows[int(course.own[-1] / STEP + 1e-6) :]
    left_mm = 1000 * float(np.hypot(*np.diff(left, axis=0).T).sum())
    wanted = float(path.rows[-1, 2])
    turned = np.degrees((p[-1, 2] - wanted + np.pi) % (2 * np.pi) - np.pi)
    return {
        "along_track_mm": along,
        "closure_mm": 1000 * float(np.hypot(*(p[-1, :2] - corners[-1]))) + left_mm,
        "cross_track_rmse_mm": 1000 * float(np.sqrt((near**2).mean())),
        "heading_error_deg": float(turned),
        "path_length_mm": 1000 * float(np.hypot(*np.diff(p[:, :2], axis=0).T).sum()),
        "energy_j": None if np.isnan(course.energy[-1]) else float(course.energy[-1]),
        "effort": float(np.sqrt((np.diff(course.command, axis=0) ** 2).mean())),
        "seconds": float(course.time[-1]),
        "finished": bool(course.own[-1] >= path.duration - 1e-6),
    }
