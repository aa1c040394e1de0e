"""Geometry of a robot's wheels: positions, drive and roller directions, and drives.

Source: Indiveri 2009, IEEE T-RO 25(1).
"""

import abc
import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.parameter import as_numbers, known

_MIRRORED = 0.01
"""Largest difference between a wheel and the mirror image of a wheel in `Geometry.mirror`.

It limits the distance of their positions, in base radii, and twice the angle between their lines
[rad].
"""


class Drives(eqx.Module):
    """Wheels and the drives that turn them.

    Attributes:
        drive_of: index of the drive that turns each wheel, from 0 (wheel,); empty if every wheel
            has a separate drive.
    """

    drive_of: eqx.AbstractVar[tuple[int, ...]]

    @property
    @abc.abstractmethod
    def wheels(self) -> int:
        """Number of wheels."""

    @property
    def drives(self) -> int:
        """Number of drives, which is also the number of logged angles, currents and voltages."""
        return len(set(self.drive_of)) or self.wheels

    def at_wheels(self, of_drives: Float[Array, "*batch drive"]) -> Float[Array, "*batch wheel"]:
        """Return for each wheel the value of its drive, such as the wheel speed."""
        return of_drives[..., jnp.asarray(self.drive_of)] if self.drive_of else of_drives

    def at_drives(self, of_wheels: Float[Array, "*batch wheel"]) -> Float[Array, "*batch drive"]:
        """Return for each drive the sum over its wheels, such as the torque."""
        if not self.drive_of:
            return of_wheels
        return of_wheels @ jnp.asarray(np.eye(self.drives)[list(self.drive_of)])

    def on_average(self, of_wheels: Float[Array, "*batch wheel"]) -> Float[Array, "*batch drive"]:
        """Return for each drive the mean over its wheels."""
        if not self.drive_of:
            return of_wheels
        return self.at_drives(of_wheels) / self.at_drives(jnp.ones(self.wheels))


class Geometry(Drives):
    """Wheels on a rigid body, REP-103 axes (x ahead, y left, yaw counter-clockwise).

    A wheel has a position, a drive direction, and rollers that run freely at `roller_angle` from
    it: 90 deg for an omni wheel, 45 deg for mecanum; `grips` marks an ordinary wheel without
    rollers. A drive is a motor with its encoder and ammeter; it turns one wheel, or several equal
    ones.

    Attributes:
        wheel_radius: r [m].
        base_radius: L [m], multiplies `place`.
        drive_offset: small rotation of each wheel's drive direction [rad].
        radius_deviation: relative deviation of each drive's wheel radius from r (drive,).
        place: wheel centres (wheel, 2) in units of the base radius.
        drive_angle: direction of travel of a positive wheel speed (wheel,) [rad].
        roller_angle: angle from the free rolling direction to the drive direction (wheel,) [rad].
        grips: True for an ordinary wheel, False for one with rollers (wheel,).
        drive_of: see `Drives`.
        gear_ratio: n, motor speed over wheel speed.
        driven: driven axle of a robot that steers, "rear" or "front"; None if no wheel is steered.
            Its base radius is the wheelbase, and its wheels are those with encoders.
    """

    wheel_radius: Array = known("m", "r", "wheel radius", start=0.05, lower=0.0, spread=0.02)
    base_radius: Array = known("m", "L", "base radius", start=0.15, lower=0.0, spread=0.02)
    drive_offset: Array = known("rad", "delta", "drive direction offset", start=0.0, spread=0.01)
    radius_deviation: Array = known(
        "1", "rho", "wheel radius over r, less 1", start=0.0, spread=0.005, of="drive"
    )
    place: tuple[tuple[float, float], ...] = eqx.field(static=True, default=())
    drive_angle: tuple[float, ...] = eqx.field(static=True, default=())
    roller_angle: tuple[float, ...] = eqx.field(static=True, default=())
    grips: tuple[bool, ...] = eqx.field(static=True, default=())
    drive_of: tuple[int, ...] = eqx.field(static=True, default=())
    gear_ratio: float = eqx.field(static=True, default=1.0)
    driven: str | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        """Raise `ValueError` for rollers that cannot drive and for drives that turn no wheel."""
        if self.drive_of and (
            len(self.drive_of) != self.wheels
            or set(self.drive_of) != set(range(len(set(self.drive_of))))
        ):
            raise ValueError(
                f"drives of the wheels {list(self.drive_of)}; expected one for each of the "
                f"{self.wheels} wheels, counted from 0 without a gap"
            )
        for k, (angle, grip) in enumerate(zip(self.roller_angle, self.grips, strict=True)):
            if not grip and abs(math.sin(angle)) < 0.05:
                raise ValueError(
                    f"wheel {k + 1}: rollers at {math.degrees(angle):g} deg to the drive "
                    "direction run freely along it, so that the wheel cannot drive (singular; "
                    "Indiveri 2009); expected 90 (omni), 45 (mecanum) or another angle that is "
                    "not near 0 or 180"
                )

    @property
    def wheels(self) -> int:
        return len(self.drive_angle)

    @property
    def determines_twist(self) -> bool:
        """True if the wheel rotations determine x, y and yaw if nothing slips."""
        return int(np.linalg.matrix_rank(np.asarray(self.forward()), tol=1e-6)) == 3

    def frame(self) -> "WheelFrame":
        """Return the wheels as rows of matrices, for the current radii and drive offsets."""
        fixed = (np.asarray(x) for x in (self.place, self.drive_angle, self.roller_angle))
        return _wheel_frame(
            MountedWheels(*fixed),
            self.drive_offset,
            self.radius_deviation,
            self.wheel_radius,
            self.base_radius,
            self.drive_of,
            self.grips,
        )

    @property
    def around(self) -> tuple[int, ...]:
        """Indices of the wheels in counter-clockwise order around the robot, beginning with 0."""
        place = np.asarray(self.place)
        x, y = (place - place.mean(axis=0)).T
        order = np.argsort(np.arctan2(y, x), kind="stable").tolist()
        first = order.index(0)
        return (*order[first:], *order[:first])

    def mirror(self) -> float | None:
        """Return the axis about which the arrangement of wheels is symmetric [rad], or None.

        The longitudinal axis (0) is tried before the lateral one (pi / 2). Wheels are compared by
        their positions and by the lines of their drives and rollers, with the tolerance `_MIRRORED`
        for positions that were measured by hand.
        """
        drive = np.asarray(self.drive_angle)
        free = np.where(self.grips, drive, drive - np.asarray(self.roller_angle))
        place = np.asarray(self.place) @ (1, 1j)
        # A line is the same after half a turn, hence the doubled angles.
        wheels = np.stack([place, np.exp(2j * drive), np.exp(2j * free)], axis=1)
        for axis in (0.0, 0.5 * math.pi):
            mirrored = np.exp(2j * axis * np.array([1, 2, 2])) * wheels.conj()
            apart = np.abs(wheels[:, None] - mirrored).max(axis=-1)
            if apart.min(axis=1).max() < _MIRRORED:
                return axis
        return None

    def forward(self) -> Float[Array, "drive 3"]:
        """Return the matrix from body twist to the drives' rim speeds, see `WheelFrame.forward`."""
        return self.frame().forward()

    def pseudo_inverse(self) -> Float[Array, "3 drive"]:
        """Return the matrix from the drives' rim speeds [m/s] to the least-squares body twist.

        This is the pseudo-inverse of `forward`. If all wheels point ahead, they do not determine
        the sideways speed, for which the matrix gives zero.
        """
        return jax.device_put(np.linalg.pinv(np.asarray(self.forward()), rcond=1e-6))


class WheelFrame(Drives):
    """Wheel directions and levers for the force balance.

    Attributes:
        hold: rows that give, from the body twist, the speed of each wheel centre along the
            direction in which its rollers do not roll (wheel, 3); for an omni wheel this is the
            drive direction.
        roll: rows that give the speed along the free rolling direction (wheel, 3).
        drive_share: component of the rim speed r w along `hold`: sin(roller angle), times the
            wheel's radius over r. The wheel activity of `contact_law` is computed with r itself.
        roller_share: component of the rim speed along `roll`: cos(roller angle), times the same
            ratio of radii.
        grip: 1 for a wheel without rollers, else 0.
        shift: change of load shares per displacement of the contact patches (wheel, 2) [1/m].
        radius: wheel radius r [m].
        base: base radius [m], by which moments are divided to compare them with forces.
        drive_of: see `Drives`.
        ordinary: True if some wheel has no rollers.
    """

    hold: Float[Array, "wheel 3"]
    roll: Float[Array, "wheel 3"]
    drive_share: Float[Array, " wheel"]
    roller_share: Float[Array, " wheel"]
    grip: Float[Array, " wheel"]
    shift: Float[Array, "wheel 2"]
    radius: Float[Array, ""]
    base: Float[Array, ""]
    drive_of: tuple[int, ...] = eqx.field(static=True)
    ordinary: bool = eqx.field(static=True)

    @property
    def wheels(self) -> int:
        return len(self.grip)

    @eqx.filter_jit
    def forward(self) -> Float[Array, "drive 3"]:
        """Return the matrix from a body twist without slip to the rim speed of each drive [m/s].

        The row of a drive with several wheels is the mean over its wheels.
        """
        return self.on_average((self.hold / self.drive_share[:, None]).T).T


class MountedWheels(NamedTuple):
    """Places and angles of the wheels as in `Geometry`, but as arrays.

    Other values of an array do not compile a function anew.
    """

    place: Float[np.ndarray, "wheel 2"]
    drive_angle: Float[np.ndarray, " wheel"]
    roller_angle: Float[np.ndarray, " wheel"]


@partial(jax.jit, static_argnames=("drive_of", "grips"))
def _wheel_frame(
    fixed: MountedWheels,
    drive_offset: Float[Array, "*wheel"],
    radius_deviation: Float[Array, "*drive"],
    radius: Float[Array, ""],
    base: Float[Array, ""],
    drive_of: tuple[int, ...],
    grips: tuple[bool, ...],
) -> WheelFrame:
    place, angle, roller = map(jnp.asarray, fixed)
    p, drive = place * base, angle + drive_offset
    deviation = jnp.broadcast_to(radius_deviation, (len(set(drive_of)) or len(grips),))
    larger = 1.0 + (deviation[np.array(drive_of)] if drive_of else deviation)
    free = drive - roller
    hold = free + 0.5 * math.pi

    def row(angle: Float[Array, " wheel"]) -> Float[Array, "wheel 3"]:
        c, s = jnp.cos(angle), jnp.sin(angle)
        return jnp.stack([c, s, p[:, 0] * s - p[:, 1] * c], axis=-1)

    # `shift`: minimum-norm change of the loads that keeps their sum and centre when the contact
    # patches are displaced, N = N0 - shift @ displacement
    lever = jnp.concatenate([jnp.ones((1, len(p))), p.T], axis=0)
    return WheelFrame(
        hold=row(hold),
        roll=row(free),
        drive_share=larger * jnp.sin(roller),
        roller_share=larger * jnp.cos(roller),
        grip=jnp.asarray(grips, dtype=float),
        shift=jnp.linalg.pinv(lever)[:, 1:],
        radius=radius,
        base=base,
        drive_of=drive_of,
        ordinary=any(grips),
    )


def omni(
    azimuth_deg: Sequence[float],
    base_radius: float,
    wheel_radius: float,
    gear_ratio: float = 1.0,
    roller_deg: float = 90.0,
    drive_of: Sequence[int] = (),
) -> Geometry:
    """Return an omni robot with any number of wheels, each of which drives tangentially.

    The drive direction is the wheel's azimuth plus 90 deg.
    """
    d = np.radians(np.asarray(azimuth_deg, float))
    place, ways = np.stack([np.cos(d), np.sin(d)], -1) * base_radius, np.degrees(d) + 90.0
    return general(place, ways, [roller_deg] * len(d), wheel_radius, gear_ratio, drive_of)


def mecanum(
    half_length: float,
    half_width: float,
    wheel_radius: float,
    gear_ratio: float = 1.0,
    drive_of: Sequence[int] = (),
) -> Geometry:
    """Return a robot with four mecanum wheels whose rollers form an X seen from above.

    The order is front left, front right, rear left, rear right.
    """
    corners = _corners(half_length, half_width)
    rollers = [135.0, 45.0, 45.0, 135.0]
    return general(corners, [0.0] * 4, rollers, wheel_radius, gear_ratio, drive_of)


def skid_steer(
    half_length: float,
    half_width: float,
    wheel_radius: float,
    gear_ratio: float = 1.0,
    drive_of: Sequence[int] = (),
) -> Geometry:
    """Return a robot with four ordinary wheels that point ahead: two at the front, two at the rear.

    The order is front left, front right, rear left, rear right. With `drive_of` (0, 1, 0, 1) each
    drive turns both wheels of one side.
    """
    corners = _corners(half_length, half_width)
    return general(corners, [0.0] * 4, [None] * 4, wheel_radius, gear_ratio, drive_of)


def differential(half_track: float, wheel_radius: float, gear_ratio: float = 1.0) -> Geometry:
    """Return a robot with two ordinary wheels on an axle, left and right, and casters."""
    axle = [(0.0, half_track), (0.0, -half_track)]
    return general(axle, [0.0] * 2, [None] * 2, wheel_radius, gear_ratio)


def steered(
    wheelbase: float, wheel_radius: float, gear_ratio: float, driven: str, encoders: int = 1
) -> Geometry:
    """Return a robot that steers, with its origin in the middle of the rear axle.

    Args:
        wheelbase: distance between the axles [m].
        wheel_radius: radius of the driven wheels [m].
        gear_ratio: motor speed over wheel speed.
        driven: driven axle, "rear" or "front".
        encoders: number of encoders on that axle; the robot moves by their mean.
    """
    return Geometry(
        wheel_radius=as_numbers(wheel_radius),
        base_radius=as_numbers(wheelbase),
        drive_offset=as_numbers(np.zeros(encoders)),
        radius_deviation=as_numbers(np.zeros(encoders)),
        place=((1.0 if driven == "front" else 0.0, 0.0),) * encoders,
        drive_angle=(0.0,) * encoders,
        roller_angle=(0.5 * math.pi,) * encoders,
        grips=(True,) * encoders,
        gear_ratio=float(gear_ratio),
        driven=driven,
    )


def _corners(a: float, b: float) -> list[tuple[float, float]]:
    return [(a, b), (a, -b), (-a, b), (-a, -b)]


def general(
    place: Sequence[Sequence[float]] | np.ndarray,
    drive_deg: Sequence[float] | np.ndarray,
    roller_deg: Sequence[float | None],
    wheel_radius: float,
    gear_ratio: float = 1.0,
    drive_of: Sequence[int] = (),
) -> Geometry:
    """Return a robot with any wheels.

    Args:
        place: wheel centres (wheel, 2) [m].
        drive_deg: drive direction of each wheel [deg].
        roller_deg: angle from the rollers' free direction to the drive [deg], None without rollers.
        wheel_radius: radius of the wheels [m].
        gear_ratio: motor speed over wheel speed.
        drive_of: index of the drive that turns each wheel, from 0; empty if every wheel has a
            separate drive.
    """
    p = np.asarray(place, float)
    base = float(np.sqrt((p**2).sum(axis=1).mean()))
    if base <= 0:
        raise ValueError("all wheels are at the origin; expected their centres in metres")
    return Geometry(
        wheel_radius=as_numbers(wheel_radius),
        base_radius=as_numbers(base),
        drive_offset=as_numbers(np.zeros(len(p))),
        radius_deviation=as_numbers(np.zeros(len(set(drive_of)) or len(p))),
        place=tuple((float(x), float(y)) for x, y in p / base),
        drive_angle=tuple(float(a) for a in np.radians(np.asarray(drive_deg, float))),
        roller_angle=tuple(math.radians(90.0 if a is None else float(a)) for a in roller_deg),
        grips=tuple(a is None for a in roller_deg),
        drive_of=tuple(int(k) for k in drive_of),
        gear_ratio=float(gear_ratio),
    )
