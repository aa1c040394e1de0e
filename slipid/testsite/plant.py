"""The robot on a floor, a millisecond at a time; MuJoCo does the mechanics."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from jaxtyping import Float

from slipid.data.floor_map import FloorMap
from slipid.support.errors import DataError
from slipid.testsite.ground import Ground
from slipid.testsite.machine import Machine, mjcf
from slipid.testsite.motors import Drive, Motor, SpeedLoop

TIMESTEP = 1e-3
"""Time step of the engine and of the speed loop [s]."""
SETTLING = 0.4
"""Time for which a robot stands still before anything is recorded [s]."""
LEVELS = 7
"""Steps of the random unevenness of a floor."""
LOOK = 5
"""Time steps between two looks at what is beneath the rollers."""
ARENA = 1.6
"""Half of the edge of the square around the start in which one surface is uneven [m]."""
GRID = 0.005
"""Cells in which the floor is looked up [m], larger on the largest floors."""
MOST_CELLS = 16_000_000
"""Largest number of cells of one floor."""
CREEP = 0.02
"""Speed at which an added force has reached 0.7 of its size [m/s]."""


def engine() -> ModuleType:
    """The mujoco module.

    Raises:
        DataError: it is not installed.
    """
    try:
        import mujoco
    except ImportError:
        raise DataError(
            "the virtual test site needs MuJoCo; expected: pip install 'slipid[testsite]'"
        ) from None
    return mujoco


@dataclass(frozen=True, eq=False)
class Trace:
    """What truly happened, a row per time step.

    Attributes:
        time: time since the end of the settling [s].
        pose: pose of the body: x, y [m], heading [rad].
        yaw_rate: [rad/s].
        wheel_angle, wheel_speed, wheel_command: [rad], [rad/s], [rad/s].
        current, voltage: those of the motors, signed along the drive direction [A], [V].
        bus: voltage of the supply [V].
        sinkage: depth to which each wheel has sunk [m].
        twist_command: what was sent to the robot at this time: [m/s, m/s, rad/s].
    """

    time: Float[np.ndarray, " step"]
    pose: Float[np.ndarray, "step 3"]
    yaw_rate: Float[np.ndarray, " step"]
    wheel_angle: Float[np.ndarray, "step wheel"]
    wheel_speed: Float[np.ndarray, "step wheel"]
    wheel_command: Float[np.ndarray, "step wheel"]
    current: Float[np.ndarray, "step wheel"]
    voltage: Float[np.ndarray, "step wheel"]
    bus: Float[np.ndarray, " step"]
    sinkage: Float[np.ndarray, "step wheel"]
    twist_command: Float[np.ndarray, "step 3"]


def _quiet(text: str) -> None:
    """Warnings are counted by the engine; `Plant.check` reads them."""


def heading_of(quaternion: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch"]:
    """Angle about the vertical of a quaternion w, x, y, z [rad]."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion), -1, 0)
    return np.asarray(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


class Plant:
    """A robot standing on a floor.

    Args:
        machine: the robot.
        motor: the motor of every wheel.
        loop: the built-in speed loop.
        floor: which surface lies where.
        grounds: physics of the floor's surfaces.
        load: name of the load set-up.
        start: x, y [m], heading [rad].
        seed: seed of how the wheels stand at first, and of the floor's unevenness.
        timestep: [s].

    Raises:
        DataError: mujoco is not installed, or a surface has no physics.
    """

    def __init__(
        self,
        machine: Machine,
        motor: Motor,
        loop: SpeedLoop,
        floor: FloorMap,
        grounds: Mapping[str, Ground],
        load: str,
        start: tuple[float, float, float] = (0.0, 0.0, 0.0),
        seed: int = 0,
        timestep: float = TIMESTEP,
    ):
        for name in floor.surfaces:
            if name not in grounds:
                choices = ", ".join(grounds)
                raise DataError(f"no physics of surface '{name}'; expected one of {choices}")
        self.machine, self.floor, self.dt = machine, floor, timestep
        mujoco = engine()
        mujoco.set_mju_user_warning(_quiet)  # else it writes a file to the working directory
        self._step = mujoco.mj_step
        self.model = mujoco.MjModel.from_xml_string(
            mjcf(machine, load, timestep, ribs(floor, grounds, start))
        )
        self.data = mujoco.MjData(self.model)
        rng = np.random.default_rng(seed)
        self._find(motor)
        self._lay(grounds, start, rng)
        self.drive = Drive(motor, loop, machine.gear_ratio, len(self.wheel_dof), timestep)
        self._place(start, rng)
        self._count = 0
        still = [0.0] * len(self.wheel_dof)
        for _ in range(round(SETTLING / timestep)):
            self.step(still)
        self.angle_at_start = self.data.qpos[self.wheel_at].copy()
        self._count = 0

    @property
    def time(self) -> float:
        """Since the end of the settling [s]."""
        return self._count * self.dt

    @property
    def pose(self) -> tuple[float, float, float]:
        """X, y [m], heading [rad, between -pi and pi] of the body."""
        q = self.data.qpos
        return float(q[0]), float(q[1]), float(heading_of(q[3:7]))

    @property
    def wheel_angle(self) -> Float[np.ndarray, " wheel"]:
        """Since the end of the settling [rad]."""
        return self.data.qpos[self.wheel_at] - self.angle_at_start

    @property
    def wheel_speed(self) -> Float[np.ndarray, " wheel"]:
        """[rad/s]."""
        return self.data.qvel[self.wheel_dof].copy()

    @property
    def sinkage(self) -> Float[np.ndarray, " wheel"]:
        """How deep each wheel's rim is in the floor [m]."""
        return np.maximum(self.machine.wheel_radius_m - self.data.xpos[self.wheel_body, 2], 0.0)

    def step(self, wanted: list[float]) -> None:
        """One time step with these wheel speeds wanted [rad/s]."""
        d = self.data
        if self._count % LOOK == 0:
            self._look()
            if self._resists:
                self._resist()
        self._count += 1
        angle, speed = d.qpos[self.wheel_at].tolist(), d.qvel[self.wheel_dof].tolist()
        d.qfrc_applied[self.wheel_dof] = self.drive.step(wanted, angle, speed)
        self._step(self.model, d)

    def check(self) -> None:
        """DataError where the engine lost the robot: it starts again from somewhere and goes on."""
        mujoco = engine()
        kinds = [f"mjWARN_BAD{what}" for what in ("QPOS", "QVEL", "QACC")]
        numbers = [int(getattr(mujoco.mjtWarning, kind)) for kind in kinds]
        lost = any(self.data.warning[k].number for k in numbers)
        if lost or not np.isfinite([*self.pose, *self.drive.current]).all():
            raise DataError(
                f"the simulation became unstable before {self.time:.2f} s; "
                "expected smaller forces, gains or stiffness"
            )

    def loads(self) -> Float[np.ndarray, " wheel"]:
        """Vertical force of the floor on each wheel at this moment [N]."""
        mujoco = engine()
        out, force = np.zeros(len(self.wheel_dof)), np.zeros(6)
        for k in range(self.data.ncon):
            contact = self.data.contact[k]
            mujoco.mj_contactForce(self.model, self.data, k, force)
            for geom in (contact.geom1, contact.geom2):
                if geom in self._wheel_of:
                    frame = contact.frame.reshape(3, 3)
                    out[self._wheel_of[geom]] += abs(float((frame.T @ force[:3])[2]))
        return out

    def _find(self, motor: Motor) -> None:
        """Addresses of wheels and rollers in the engine's arrays."""
        m, count = self.model, len(self.machine.wheel_azimuths_deg)
        joints = [m.joint(f"wheel{k}") for k in range(count)]
        self.wheel_dof = np.array([j.dofadr[0] for j in joints])
        self.wheel_at = np.array([j.qposadr[0] for j in joints])
        self.wheel_body = np.array([m.body(f"wheel{k}").id for k in range(count)])
        each = [(k, j) for k in range(count) for j in range(self.machine.rollers)]
        self._roller = np.array([m.geom(f"roller{k}_{j}").id for k, j in each])
        self._wheel_of = {int(g): k for g, (k, _) in zip(self._roller, each, strict=True)}
        mounts = [m.joint(f"mount{k}_{j}") for k, j in each]
        self._axle_dof = np.array([m.joint(f"roller{k}_{j}").dofadr[0] for k, j in each])
        self._mount = np.array([j.id for j in mounts])
        self._mount_dof = np.array([j.dofadr[0] for j in mounts])
        m.dof_armature[self.wheel_dof] = motor.rotor_inertia_kg_m2 * self.machine.gear_ratio**2
        m.dof_frictionloss[self.wheel_dof] = motor.coulomb_nm
        m.dof_damping[self.wheel_dof] = motor.viscous_nms

    def _lay(
        self,
        grounds: Mapping[str, Ground],
        start: tuple[float, float, float],
        rng: np.random.Generator,
    ) -> None:
        """Contact parameters of every kind (surface, level of unevenness), and where each lies."""
        own = [grounds[name] for name in self.floor.surfaces]
        kinds = [(g, np.exp(g.unevenness * v)) for g in own for v in np.linspace(-1.5, 1.5, LEVELS)]
        self._friction = np.array([[g.friction, 0.003, f * g.rolling_m] for g, f in kinds])
        self._contact = np.array([[max(g.settling_s, 2 * self.dt), 1.0] for g, _ in kinds])
        mount = self.machine.mount_n_m
        self._shear = np.array([1 / (1 / mount + f / g.shear_n_m) for g, f in kinds])
        self._damping = 1.4 * np.sqrt(self._shear * self.machine.roller_mass_kg)
        self._compaction = [g.compaction for g in own]
        self._body_drag = [g.body_drag_n for g in own]
        self._resists = any(self._compaction) or any(self._body_drag)
        x0, y0, x1, y1 = arena(self.floor, start)
        self._corner = np.array([x0, y0])
        self._cell = max(GRID, ((x1 - x0) * (y1 - y0) / MOST_CELLS) ** 0.5)
        x = np.arange(x0, x1, self._cell) + 0.5 * self._cell
        y = np.arange(y0, y1, self._cell) + 0.5 * self._cell
        surface = self.floor.at(np.stack(np.meshgrid(x, y), -1))
        self._kinds = surface * LEVELS + _uneven(x, y, rng)
        self._beneath = np.full(len(self._roller), -1)
        self._low = np.full(len(self._roller), -1)

    def _place(self, start: tuple[float, float, float], rng: np.random.Generator) -> None:
        """Put the robot at its start, with every wheel turned at random."""
        q = self.data.qpos
        q[:2] = start[:2]
        q[3], q[6] = np.cos(0.5 * start[2]), np.sin(0.5 * start[2])
        q[self.wheel_at] = rng.uniform(0, 2 * np.pi, len(self.wheel_at))
        engine().mj_forward(self.model, self.data)

    def _kind(self, xy: Float[np.ndarray, "place 2"]) -> np.ndarray:
        """Surface and level of unevenness at places."""
        column, row = ((xy - self._corner) * (1 / self._cell)).astype(np.intp).T
        rows, columns = self._kinds.shape
        return self._kinds[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]

    def _look(self) -> None:
        """Give every roller the contact parameters of the floor beneath it.

        The bearings of rollers that are off the floor turn freely: the engine has less to solve.
        """
        place = self.data.geom_xpos[self._roller]
        now, m = self._kind(place[:, :2]), self.model
        new = np.flatnonzero(now != self._beneath)
        if len(new):
            self._beneath = now
            which, geoms = now[new], self._roller[new]
            m.geom_friction[geoms] = self._friction[which]
            m.geom_solref[geoms] = self._contact[which]
            m.jnt_stiffness[self._mount[new]] = self._shear[which]
            m.dof_damping[self._mount_dof[new]] = self._damping[which]
        low = place[:, 2] < 0.5 * self.machine.wheel_radius_m
        if (low != self._low).any():
            self._low = low
            m.dof_frictionloss[self._axle_dof] = np.where(low, self.machine.roller_friction_nm, 0.0)

    def _resist(self) -> None:
        """Compaction at sunk wheels and drag on the body, as a wrench on the chassis."""
        d = self.data
        vx, vy, _, _, _, turn = d.qvel[:6].tolist()
        x0, y0, z0 = d.qpos[:3].tolist()
        places = d.xpos[self.wheel_body]
        beneath = self._kind(places[:, :2]) // LEVELS
        fx = fy = moment = 0.0
        for (x, y, z), ground in zip(places.tolist(), beneath.tolist(), strict=True):
            hard = self._compaction[ground] * max(self.machine.wheel_radius_m - z, 0.0) ** 1.5
            ux, uy = vx - turn * (y - y0), vy + turn * (x - x0)
            size = hard / (ux * ux + uy * uy + CREEP**2) ** 0.5
            fx -= size * ux
            fy -= size * uy
            moment -= size * ((x - x0) * uy - (y - y0) * ux)
        size = sum(self._body_drag[g] for g in beneath.tolist()) / len(places)
        size /= (vx * vx + vy * vy + CREEP**2) ** 0.5
        fx, fy = fx - size * vx, fy - size * vy
        heading = self.pose[2]
        c, s = np.cos(heading), np.sin(heading)
        mx, my = z0 * fy, -z0 * fx  # it acts at the floor, z0 below the axes
        d.qfrc_applied[:6] = [fx, fy, 0.0, c * mx + s * my, c * my - s * mx, moment]


def _uneven(
    x: Float[np.ndarray, " column"], y: Float[np.ndarray, " row"], rng: np.random.Generator
) -> np.ndarray:
    """Levels of a smooth random field (row, column): plane waves of about a hand's width."""
    waves = 6
    angle = rng.uniform(0, 2 * np.pi, waves)
    number = 2 * np.pi / rng.uniform(0.08, 0.3, waves)
    phase = rng.uniform(0, 2 * np.pi, waves)
    field = np.zeros((len(y), len(x)))
    for a, k, p in zip(angle, number, phase, strict=True):  # sin(u + v) from its parts
        u, v = k * np.cos(a) * x + p, k * np.sin(a) * y
        field += np.outer(np.cos(v), np.sin(u)) + np.outer(np.sin(v), np.cos(u))
    field *= (2 / waves) ** 0.5
    return np.clip(np.rint((field + 1.5) / 3 * (LEVELS - 1)), 0, LEVELS - 1).astype(np.intp)


def arena(floor: FloorMap, start: tuple[float, float, float]) -> tuple[float, float, float, float]:
    """Lowest x, y, highest x, y [m] of where a floor is made: all of a map, or around the start."""
    if len(floor.surfaces) > 1:
        return floor.extent
    x, y, _ = start
    return x - ARENA, y - ARENA, x + ARENA, y + ARENA


def ribs(
    floor: FloorMap, grounds: Mapping[str, Ground], start: tuple[float, float, float]
) -> list[tuple[float, float, float, float]]:
    """Ribs along y: x, lowest y, highest y, height [m] of each; none beyond `arena`."""
    out: list[tuple[float, float, float, float]] = []
    left, low, right, high = arena(floor, start)
    fine = min(floor.cell, 0.02)
    y = np.arange(low + 0.5 * fine, high, fine)
    for number, name in enumerate(floor.surfaces):
        ground = grounds[name]
        if ground.rib_height_m <= 0:
            continue
        for x in np.arange(left, right, ground.rib_distance_m):
            on = floor.at(np.stack([np.full_like(y, x), y], 1)) == number
            ends = np.flatnonzero(np.diff(np.concatenate([[0], on.astype(int), [0]])))
            out += [
                (float(x), low + fine * float(a), low + fine * float(b), ground.rib_height_m)
                for a, b in ends.reshape(-1, 2)
            ]
    return out
