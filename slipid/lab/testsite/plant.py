"""The simulated robot on a floor; MuJoCo computes its mechanics in steps of a millisecond."""

from types import ModuleType

import numpy as np
from jaxtyping import Float

from slipid.data.floor_map import FloorMap
from slipid.lab.testsite.robot_build import MotorBuild, WheelDrives, mjcf
from slipid.lab.testsite.site import Site
from slipid.lab.testsite.surfaces import Pose, Terrain, ribs
from slipid.support.errors import DataError

TIMESTEP = 1e-3
"""Time step of the engine and of the speed loop [s]."""
SETTLING_S = 0.4
"""Time for which the robot settles on the floor before recording starts [s]."""
LOOKUP_STEPS = 5
"""Number of time steps from one lookup of the floor beneath the rollers to the next."""
RESISTANCE_SPEED = 0.02
"""Speed at which compaction and body drag reach 0.7 of their full force [m/s]."""


def engine() -> ModuleType:
    """Return the mujoco module; raise `DataError` if it is not installed."""
    try:
        import mujoco
    except ImportError:
        raise DataError(
            "the virtual test site needs MuJoCo; expected: pip install 'slipid[testsite]'"
        ) from None
    return mujoco


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
        self._store_contacts(Terrain(floor, site.surfaces, start, rng))
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
        """Angle by which each wheel has turned since the robot had settled [rad]."""
        return self.data.qpos[self.wheel_at] - self.angle_at_start

    def step(self, wanted: list[float]) -> None:
        """Advance by one time step with these commanded wheel speeds [rad/s]."""
        d = self.data
        if self._count % LOOKUP_STEPS == 0:
            self._look()
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
        """Look up wheels and rollers in the engine's arrays, and set the motors' properties."""
        m, count = self.model, len(self.robot.wheel_azimuths_deg)
        joints = [m.joint(f"wheel{k}") for k in range(count)]
        self.wheel_dof = np.array([j.dofadr[0] for j in joints])
        self.wheel_at = np.array([j.qposadr[0] for j in joints])
        self.wheel_body = np.array([m.body(f"wheel{k}").id for k in range(count)])
        each = [(k, j) for k in range(count) for j in range(self.robot.rollers)]
        self._roller = np.array([m.geom(f"roller{k}_{j}").id for k, j in each])
        mounts = [m.joint(f"mount{k}_{j}") for k, j in each]
        self._axle_dof = np.array([m.joint(f"roller{k}_{j}").dofadr[0] for k, j in each])
        self._mount = np.array([j.id for j in mounts])
        self._mount_dof = np.array([j.dofadr[0] for j in mounts])
        m.dof_armature[self.wheel_dof] = motor.rotor_inertia_kg_m2 * self.robot.gear_ratio**2
        m.dof_frictionloss[self.wheel_dof] = motor.coulomb_nm
        m.dof_damping[self.wheel_dof] = motor.viscous_nms

    def _store_contacts(self, terrain: Terrain) -> None:
        """Store contact parameters for every kind (surface and unevenness level) of the terrain."""
        self.terrain = terrain
        kinds = terrain.kinds
        self._friction = np.array([[g.friction, 0.003, f * g.rolling_m] for g, f in kinds])
        self._contact = np.array([[max(g.settling_s, 2 * self.dt), 1.0] for g, _ in kinds])
        mount = self.robot.mount_n_m
        self._shear = np.array([1 / (1 / mount + f / g.shear_n_m) for g, f in kinds])
        self._damping = 1.4 * np.sqrt(self._shear * self.robot.roller_mass_kg)
        self._resists = any(g.compaction or g.body_drag_n for g, _ in kinds)
        self._beneath = np.full(len(self._roller), -1)
        self._low = np.full(len(self._roller), -1)

    def _put(self, start: Pose, rng: np.random.Generator) -> None:
        """Put the robot at its start pose, with a random angle of every wheel."""
        q = self.data.qpos
        q[:2] = start[:2]
        q[3], q[6] = np.cos(0.5 * start[2]), np.sin(0.5 * start[2])
        q[self.wheel_at] = rng.uniform(0, 2 * np.pi, len(self.wheel_at))
        engine().mj_forward(self.model, self.data)

    def _look(self) -> None:
        """Give every roller the contact parameters of the floor beneath it.

        Rollers that are not near the floor get no bearing friction, which saves computing time.
        """
        place = self.data.geom_xpos[self._roller]
        now, m = self.terrain.at(place[:, :2]), self.model
        new = np.flatnonzero(now != self._beneath)
        if len(new):
            self._beneath = now
            which, geoms = now[new], self._roller[new]
            m.geom_friction[geoms] = self._friction[which]
            m.geom_solref[geoms] = self._contact[which]
            m.jnt_stiffness[self._mount[new]] = self._shear[which]
            m.dof_damping[self._mount_dof[new]] = self._damping[which]
        low = place[:, 2] < 0.5 * self.robot.wheel_radius_m
        if (low != self._low).any():
            self._low = low
            m.dof_frictionloss[self._axle_dof] = np.where(low, self.robot.roller_friction_nm, 0.0)

    def _apply_resistance(self) -> None:
        """Apply compaction forces on sunk wheels and the body drag as a wrench on the chassis."""
        d = self.data
        vx, vy, _, _, _, turn = d.qvel[:6].tolist()
        x0, y0, z0 = d.qpos[:3].tolist()
        places = d.xpos[self.wheel_body]
        beneath = [self.terrain.kinds[k][0] for k in self.terrain.at(places[:, :2]).tolist()]
        fx = fy = moment = 0.0
        for (x, y, z), surface in zip(places.tolist(), beneath, strict=True):
            hard = surface.compaction * max(self.robot.wheel_radius_m - z, 0.0) ** 1.5
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
