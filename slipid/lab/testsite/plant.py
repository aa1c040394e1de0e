"""The simulated robot on a floor; MuJoCo computes its mechanics in steps of a millisecond."""

from types import ModuleType

import numpy as np
from jaxtyping import Float

from slipid.data.floor_map import FloorMap
from slipid.lab.testsite.contacts import contacts_of
from slipid.lab.testsite.motors import MotorBuild, WheelDrives
from slipid.lab.testsite.robot_build import mjcf
from slipid.lab.testsite.site import Site
from slipid.lab.testsite.surfaces import Pose, Terrain, ribs
from slipid.support.errors import DataError
from slipid.support.extras import require

TIMESTEP = 1e-3
"""Time step of the engine and of the speed loop [s]."""
SETTLING_S = 0.4
"""Time for which the robot settles on the floor before recording starts [s]."""
LOOKUP_STEPS = 5
"""Number of time steps from one lookup of the floor beneath the wheels to the next."""
RESISTANCE_SPEED = 0.02
"""Speed at which compaction and body drag reach 0.7 of their full force [m/s]."""


def engine() -> ModuleType:
    """Return the mujoco module; raise `MissingExtra` if it is not installed."""
    return require("mujoco", "testsite", "the virtual test site")


def heading_of(quaternion: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch"]:
    """Return the heading of a rotation given as quaternion (w, x, y, z) [rad]."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion), -1, 0)
    return np.asarray(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


class SimulatedRobot:
    """MuJoCo simulation of the robot on a floor, settled at its start pose.

    Args:
        site: the robot's build, its sensors and the surfaces.
        floor: map of surfaces of the site.
        load: name of the load set-up.
        start: start pose: x, y [m], heading [rad].
        seed: seed of the initial wheel angles and of the floor's unevenness.
        timestep: time step of the engine [s].
    """

    def __init__(
        self,
        site: Site,
        floor: FloorMap,
        load: str,
        start: Pose = (0.0, 0.0, 0.0),
        seed: int = 0,
        timestep: float = TIMESTEP,
    ):
        self.robot, self.dt = site.robot, timestep
        mujoco = engine()
        # stop MuJoCo from writing warnings to a file: `check` reads the engine's warning counts
        mujoco.set_mju_user_warning(lambda text: None)
        self._step = mujoco.mj_step
        self.model = mujoco.MjModel.from_xml_string(
            mjcf(self.robot, load, timestep, ribs(floor, site.surfaces, start))
        )
        self.data = mujoco.MjData(self.model)
        rng = np.random.default_rng(seed)
        self._look_up(site.motor)
        self.terrain = Terrain(floor, site.surfaces, start, rng)
        self._resists = any(g.compaction or g.body_drag_n for g, _ in self.terrain.kinds)
        self._contacts = contacts_of(self.robot, load, self.terrain, self.model, timestep)
        self.drive = WheelDrives(
            site.motor, site.loop, self.robot.gear_ratio, len(self.wheel_dof), timestep
        )
        self._put(start, rng)
        self._count = 0
        for _ in range(round(SETTLING_S / timestep)):
            self.step([0.0] * len(self.wheel_dof))
        self.angle_at_start = self.data.qpos[self.wheel_at].copy()
        self._count = 0

    @property
    def time(self) -> float:
        """Time since the robot had settled on the floor [s]."""
        return self._count * self.dt

    @property
    def pose(self) -> Pose:
        """Pose of the body: x, y [m], heading [rad, between -pi and pi]."""
        q = self.data.qpos
        return float(q[0]), float(q[1]), float(heading_of(q[3:7]))

    @property
    def wheel_angle(self) -> Float[np.ndarray, " wheel"]:
        """Angle by which each drive has turned its wheels since the robot had settled [rad]."""
        return self.data.qpos[self.wheel_at] - self.angle_at_start

    def step(self, wanted: list[float]) -> None:
        """Advance by one time step with these commanded wheel speeds [rad/s]."""
        d = self.data
        if self._count % LOOKUP_STEPS == 0:
            self._contacts.look(self.data)
            if self._resists:
                self._apply_resistance()
        self._count += 1
        angle, speed = d.qpos[self.wheel_at].tolist(), d.qvel[self.wheel_dof].tolist()
        d.qfrc_applied[self.wheel_dof] = self.drive.step(wanted, angle, speed)
        self._step(self.model, d)

    def check(self) -> None:
        """Raise `DataError` if the simulation became unstable.

        The engine itself does not stop: it counts a warning, resets the robot and continues.
        """
        mujoco = engine()
        kinds = [f"mjWARN_BAD{what}" for what in ("QPOS", "QVEL", "QACC")]
        numbers = [int(getattr(mujoco.mjtWarning, kind)) for kind in kinds]
        lost = any(self.data.warning[k].number for k in numbers)
        if lost or not np.isfinite([*self.pose, *self.drive.current]).all():
            raise DataError(
                f"the simulation became unstable before {self.time:.2f} s; "
                "expected smaller forces, gains or stiffness"
            )

    def _look_up(self, motor: MotorBuild) -> None:
        """Look up the wheels in the engine's arrays, and set the motors' properties.

        A drive stands for all its wheels: its angle and speed are those of its first wheel.
        """
        m, drives = self.model, self.robot.drives
        wheels = [f"wheel{k}" for k in range(len(self.robot.places))]
        joints = [m.joint(name) for name in wheels]
        self.wheel_dof = np.array([j.dofadr[0] for j in joints[:drives]])
        self._every_wheel_at = np.array([j.qposadr[0] for j in joints])
        self.wheel_at = self._every_wheel_at[:drives]
        self.wheel_body = np.array([m.body(name).id for name in wheels])
        m.dof_armature[self.wheel_dof] = motor.rotor_inertia_kg_m2 * self.robot.gear_ratio**2
        m.dof_frictionloss[self.wheel_dof] = motor.coulomb_nm
        m.dof_damping[self.wheel_dof] = motor.viscous_nms

    def _put(self, start: Pose, rng: np.random.Generator) -> None:
        """Put the robot at its start pose, with a random angle of every wheel."""
        q = self.data.qpos
        q[:2] = start[:2]
        q[3], q[6] = np.cos(0.5 * start[2]), np.sin(0.5 * start[2])
        angle = rng.uniform(0, 2 * np.pi, self.robot.drives)
        q[self._every_wheel_at] = angle[list(self.robot.drive_of)]
        engine().mj_forward(self.model, self.data)

    def _apply_resistance(self) -> None:
        """Apply compaction forces on sunk wheels and the body drag as a wrench on the chassis."""
        d = self.data
        vx, vy, _, _, _, turn = d.qvel[:6].tolist()
        x0, y0, z0 = d.qpos[:3].tolist()
        places = d.xpos[self.wheel_body]
        beneath = [self.terrain.kinds[k][0] for k in self.terrain.at(places[:, :2]).tolist()]
        fx = fy = moment = 0.0
        radii = self.robot.radii.tolist()
        for (x, y, z), radius, surface in zip(places.tolist(), radii, beneath, strict=True):
            hard = surface.compaction * max(radius - z, 0.0) ** 1.5
            ux, uy = vx - turn * (y - y0), vy + turn * (x - x0)
            size = hard / (ux * ux + uy * uy + RESISTANCE_SPEED**2) ** 0.5
            fx -= size * ux
            fy -= size * uy
            moment -= size * ((x - x0) * uy - (y - y0) * ux)
        size = sum(g.body_drag_n for g in beneath) / len(places)
        size /= (vx * vx + vy * vy + RESISTANCE_SPEED**2) ** 0.5
        fx, fy = fx - size * vx, fy - size * vy
        heading = self.pose[2]
        c, s = np.cos(heading), np.sin(heading)
        # the force acts at the floor, z0 below the wheel axes, and so also tilts the chassis
        mx, my = z0 * fy, -z0 * fx
        d.qfrc_applied[:6] = [fx, fy, 0.0, c * mx + s * my, c * my - s * mx, moment]
