"""A plant without forces that closes a loop quickly: wheels with a delay and a lag, and slip."""

import numpy as np
from jaxtyping import Float

from slipid.robot.deployed import RobotArrays
from slipid.robot.interface import PERIOD, Measurement, Pose


class Unicycle:
    """A robot of any drive whose body moves by calibrated kinematics.

        w <- w + (1 - exp(-h / lag)) (command(t - delay) - w),  xi = diag(1, 1, 1 / track) M (f w)

    with w the wheel speeds [rad/s], M the matrix from wheel speeds to body twist, f the factors
    `radius`, and h the substep [s]. The body moves on exact arcs.

    Attributes:
        powered: False while the motors are cut and the wheels stand still; tests may change it.
        pose: true pose [m, m, rad].
        wheel_speed: speeds of the wheels of each drive [rad/s].
        twist: twist of the body [m/s, m/s, rad/s].
    """

    SUBSTEPS = 5

    def __init__(
        self,
        robot: RobotArrays,
        start: Pose = (0.0, 0.0, 0.0),
        delay_s: float = 0.0,
        lag_s: float = 0.0,
        radius: float | Float[np.ndarray, " drive"] = 1.0,
        track: float = 1.0,
        gyro: bool = False,
    ):
        """Place the robot, at rest.

        Args:
            robot: robot that the wheels and the nominal lengths belong to.
            start: true pose at the start [m, m, rad].
            delay_s: time until a command reaches the wheels, rounded to substeps [s].
            lag_s: time constant of the wheels' speed control [s].
            radius: effective over nominal rolling radius of each drive [1].
            track: effective over nominal track or base [1].
            gyro: True if yaw rates are measured.
        """
        matrix = np.asarray(robot.inverse) * float(robot.frame.radius) * radius
        self.matrix = matrix / np.array([1.0, 1.0, track])[:, None]
        self.powered, self.gyro = True, gyro
        self._place = np.array(start, float)
        self._step = PERIOD / self.SUBSTEPS
        self._gain = 1.0 - np.exp(-self._step / lag_s) if lag_s > 0 else 1.0
        self.wheel_speed, self.angle = np.zeros(robot.drives), np.zeros(robot.drives)
        self._waiting = [np.zeros(robot.drives)] * round(delay_s / self._step)

    @property
    def pose(self) -> tuple[float, float, float]:
        x, y, heading = self._place.tolist()
        return x, y, heading

    @property
    def twist(self) -> Float[np.ndarray, "3"]:
        return self.matrix @ self.wheel_speed

    def reset(self) -> Measurement:
        """Readings of the robot at rest."""
        return self.step(np.zeros_like(self.angle))

    def step(self, wheel_speed: Float[np.ndarray, " drive"]) -> Measurement:
        """Readings one control period after a command of these wheel speeds [rad/s]."""
        for _ in range(self.SUBSTEPS):
            self._waiting.append(np.asarray(wheel_speed))
            wanted = self._waiting.pop(0)
            self.wheel_speed = self.wheel_speed + self._gain * (wanted - self.wheel_speed)
            self.wheel_speed = self.wheel_speed * self.powered
            self.angle = self.angle + self.wheel_speed * self._step
            x, y, turned = self.twist * self._step
            # the chord of an arc has the heading of its middle
            chord = np.sinc(turned / (2 * np.pi)) * np.exp(1j * (self._place[2] + 0.5 * turned))
            moved = chord * (x + 1j * y)
            self._place += [moved.real, moved.imag, turned]
        yaw_rate = float(self.twist[2]) if self.gyro else None
        current = np.full_like(self.angle, 0.5)
        return Measurement(wheel_angle=self.angle, current=current, gyro=yaw_rate)
