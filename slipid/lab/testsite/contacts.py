"""Contacts of a robot with the floor: parameters of the engine that follow the floor beneath."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from slipid.lab.testsite.omni_build import OmniBuild
from slipid.lab.testsite.ordinary_build import IMPEDANCE, OrdinaryBuild
from slipid.lab.testsite.robot_build import RobotBuild
from slipid.lab.testsite.surfaces import GRAVITY, Terrain

CREEP_RATE = 200.0
"""Rate at which creep follows a change of force [1/s].

The engine's friction also resists accelerations, among them that towards the middle of a curve, the
less the higher this rate is.
"""
POINTS = 2
"""Number of points at which a cylinder touches a plane [1]."""


class RollerContacts:
    """Contacts of the rollers of an omnidirectional robot.

    Args:
        robot: dimensions and masses of the robot.
        terrain: floor around the start.
        model: model of the engine, whose parameters change with the floor.
        timestep: time step of the engine [s].
    """

    def __init__(self, robot: OmniBuild, terrain: Terrain, model: Any, timestep: float):
        self.robot, self.terrain, self.model = robot, terrain, model
        each = [(k, j) for k in range(len(robot.places)) for j in range(robot.rollers)]
        self._roller = np.array([model.geom(f"roller{k}_{j}").id for k, j in each])
        mounts = [model.joint(f"mount{k}_{j}") for k, j in each]
        self._axle_dof = np.array([model.joint(f"roller{k}_{j}").dofadr[0] for k, j in each])
        self._mount = np.array([j.id for j in mounts])
        self._mount_dof = np.array([j.dofadr[0] for j in mounts])
        kinds = terrain.kinds
        self._friction = np.array([[g.friction, 0.003, f * g.rolling_m] for g, f in kinds])
        self._contact = np.array([[max(g.settling_s, 2 * timestep), 1.0] for g, _ in kinds])
        self._shear = np.array([1 / (1 / robot.mount_n_m + f / g.shear_n_m) for g, f in kinds])
        self._damping = 1.4 * np.sqrt(self._shear * robot.roller_mass_kg)
        self._beneath = np.full(len(self._roller), -1)
        self._low = np.full(len(self._roller), -1)

    def look(self, data: Any) -> None:
        """Give every roller the parameters of the floor beneath it.

        Rollers that are not near the floor get no bearing friction, which saves computing time.
        """
        place = data.geom_xpos[self._roller]
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


class TreadContacts:
    """Contacts of ordinary wheels, which are cylinders, and of a castor ball.

    A wheel presses the floor in against a spring. Where the floor yields under shear, the engine's
    friction gives way: fresh floor enters the contact, of length l, and is sheared until it leaves,
    so that a force F lets a wheel that rolls at the speed v slide at F v / (k l), k being the
    floor's shear stiffness. At the friction limit the wheel slides. Rolling friction acts at
    the wheel's axle, with the load at rest.

    Args:
        robot: dimensions and masses of the robot.
        load: name of the load set-up.
        terrain: floor around the start.
        model: model of the engine, whose parameters change with the floor.
        timestep: time step of the engine [s].
    """

    def __init__(
        self, robot: OrdinaryBuild, load: str, terrain: Terrain, model: Any, timestep: float
    ):
        self.terrain, self.model, self._radius = terrain, model, robot.radii
        count = len(robot.places)
        names = [f"tread{k}" for k in range(count)]
        names += ["castor"] if robot.castor_m is not None else []
        self._geom = np.array([model.geom(name).id for name in names])
        self._pair = np.array([model.pair(name).id for name in names])
        joints = [model.joint(name.replace("tread", "wheel")) for name in names]
        self._dof = np.array([j.dofadr[0] for j in joints[:count]])
        self._castor_dofs = [d for j in joints[count:] for d in range(j.dofadr[0], j.dofadr[0] + 3)]
        self._bearing = np.array(model.dof_frictionloss[self._dof])
        self._castor_bearing = robot.castor_friction_nm
        self._load = robot.mass_kg * GRAVITY * robot.support_share(load)
        points = np.array([POINTS] * count + [1] * (len(names) - count))
        self._points, self._firmness = points, model.opt.impratio
        self._inverse_mass = model.body_invweight0[model.geom_bodyid[self._geom], 0]
        self._fastest = 0.5 / timestep
        third = robot.mass_kg * GRAVITY / 3
        kinds = terrain.kinds
        self._friction = np.array([g.friction for g, _ in kinds])
        self._rolling = np.array([f * g.rolling_m for g, f in kinds])
        self._stiffness = np.array([third / g.softness_m for g, _ in kinds])
        self._shear = np.array([g.shear_n_m / f for g, f in kinds])
        self._damping = 1.4 * np.sqrt(self._stiffness * robot.mass_kg / len(names))
        self._beneath = np.full(len(names), -1)

    def look(self, data: Any) -> None:
        """Give wheels and castor the parameters of the floor beneath them."""
        m, place, wheels = self.model, data.geom_xpos[self._geom], len(self._dof)
        now = self.terrain.at(place[:, :2])
        if (now != self._beneath).any():
            self._beneath = now
            friction = self._friction[now, None]
            m.pair_friction[self._pair, :2] = m.geom_friction[self._geom, :1] = friction
            m.geom_solref[self._geom] = self._normal(now, IMPEDANCE)
            rolling = self._rolling[now] * self._load
            m.dof_frictionloss[self._dof] = self._bearing + rolling[:wheels]
            m.dof_frictionloss[self._castor_dofs] = self._castor_bearing + rolling[wheels:].sum()
        sinkage = np.maximum(self._radius - place[:wheels, 2], 1e-6)
        length = 2 * np.sqrt(2 * self._radius * sinkage)
        speed = np.abs(data.qvel[self._dof]) * self._radius
        damping = np.full(len(now), np.inf)  # of the friction at one point [N s/m]
        damping[:wheels] = self._shear[now[:wheels]] * length / np.maximum(speed, 1e-6) / POINTS
        # regularisation of the friction for which creep follows the force at the rate CREEP_RATE
        soft = self._firmness * CREEP_RATE / damping
        impedance = np.clip(self._inverse_mass / (self._inverse_mass + soft), 1e-3, IMPEDANCE)
        scale = (1 - impedance) * self._inverse_mass / self._firmness
        m.pair_solimp[self._pair, :2] = impedance[:, None]
        m.pair_solref[self._pair] = self._normal(now, impedance)
        m.pair_solreffriction[self._pair, 0] = -1.0  # without effect: friction has no position
        m.pair_solreffriction[self._pair, 1] = -np.minimum(
            damping * scale, self._fastest * impedance
        )

    def _normal(
        self, kinds: Int[np.ndarray, " contact"], impedance: Float[np.ndarray, " contact"] | float
    ) -> Float[np.ndarray, "contact 2"]:
        """Return the engine's numbers for stiffness and damping of the floor under a contact."""
        scale = (1 - impedance) * self._inverse_mass / self._points
        return -np.stack([self._stiffness[kinds], self._damping[kinds]], 1) * scale[:, None]


def contacts_of(
    robot: RobotBuild, load: str, terrain: Terrain, model: Any, timestep: float
) -> RollerContacts | TreadContacts:
    """Return the contacts of a robot with the floor; arguments as in `TreadContacts`."""
    if isinstance(robot, OmniBuild):
        return RollerContacts(robot, terrain, model, timestep)
    assert isinstance(robot, OrdinaryBuild)
    return TreadContacts(robot, load, terrain, model, timestep)
