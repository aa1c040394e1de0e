"""DC motors of the test site's robot, with their wheel speed loop and battery."""

from math import exp, floor, pi
from typing import Annotated, Literal

from pydantic.dataclasses import dataclass

from slipid.support.quantities import Bounds
from slipid.support.toml_file import CLOSED


@dataclass(frozen=True, config=CLOSED)
class MotorBuild:
    """A brushed DC motor with its gear.

    Attributes:
        resistance_ohm, inductance_h: resistance and inductance of the winding.
        back_emf_vs: back-EMF constant, equal to the torque constant [V s/rad].
        rotor_inertia_kg_m2: inertia at the motor shaft.
        coulomb_nm, viscous_nms: Coulomb and viscous friction at the wheel [N m], [N m s].
        efficiency: efficiency of the gear while the motor drives the wheel.
        supply_v, supply_ohm: open-circuit voltage [V] and internal resistance [ohm] of the battery
            that all motors share; under load its voltage never falls below 5 % of `supply_v`.
        ticks_per_revolution: encoder ticks per turn of the motor shaft.
    """

    resistance_ohm: Annotated[float, Bounds(1e-6, 1e6, "ohm")] = 5.5
    inductance_h: Annotated[float, Bounds(1e-9, 1e3, "H")] = 8.9e-3
    back_emf_vs: Annotated[float, Bounds(1e-6, 1e4, "V s/rad")] = 0.0514
    rotor_inertia_kg_m2: Annotated[float, Bounds(1e-12, 1e6, "kg m^2")] = 7.1e-6
    coulomb_nm: Annotated[float, Bounds(0, 1e6, "N m")] = 0.07
    viscous_nms: Annotated[float, Bounds(0, 1e6, "N m s")] = 0.006
    efficiency: Annotated[float, Bounds(1e-3, 1)] = 0.9
    supply_v: Annotated[float, Bounds(0.1, 1e4, "V")] = 24.0
    supply_ohm: Annotated[float, Bounds(0, 1e3, "ohm")] = 0.15
    ticks_per_revolution: Annotated[int, Bounds(10, 10**9)] = 2000


@dataclass(frozen=True, config=CLOSED)
class SpeedLoop:
    """The robot's built-in controller of wheel speed, which runs at the engine's time step.

    Attributes:
        kind: `pi`; `feed_forward` (proportional, plus the back-EMF of the commanded speed);
            `cascade` (a PI controller commands a current, which an inner loop controls).
        gain: gain of the error in motor speed [V s/rad]; in a cascade [A s/rad].
        integral: gain of the error's integral [V/rad]; in a cascade [A/rad].
        current_gain: gain of the cascade's inner loop [V/A].
        current_limit_a: limit of the cascade's commanded current [A].
        filter_s: time constant of the low pass of the measured speed [s].
    """

    kind: Literal["pi", "feed_forward", "cascade"] = "pi"
    gain: Annotated[float, Bounds(0, 1e6)] = 0.08
    integral: Annotated[float, Bounds(0, 1e6)] = 0.8
    current_gain: Annotated[float, Bounds(0, 1e6)] = 4.0
    current_limit_a: Annotated[float, Bounds(1e-3, 1e5, "A")] = 3.0
    filter_s: Annotated[float, Bounds(0, 10, "s")] = 0.004


class WheelDrives:
    """Simulation of all motors with their speed loops and battery, in steps of `dt` [s].

    `current` [A] and `voltage` [V] have a value for each motor; `bus` is the battery's voltage [V].
    """

    def __init__(
        self, motor: MotorBuild, loop: SpeedLoop, gear_ratio: float, wheels: int, dt: float
    ):
        self.motor, self.loop, self.gear, self.dt = motor, loop, gear_ratio, dt
        self._per_tick = 2 * pi / (motor.ticks_per_revolution * gear_ratio)
        self._decay = exp(-dt * motor.resistance_ohm / motor.inductance_h)
        self._blend = 1 - exp(-dt / loop.filter_s) if loop.filter_s > 0 else 1.0
        self.current = [0.0] * wheels
        self.voltage = [0.0] * wheels
        self.bus = motor.supply_v
        self._integral = [0.0] * wheels
        self._speed = [0.0] * wheels
        self._ticks: list[int] | None = None

    def step(self, wanted: list[float], angle: list[float], speed: list[float]) -> list[float]:
        """Return the torques at the wheels over one step [N m].

        Args:
            wanted: commanded wheel speeds [rad/s].
            angle: angles of the wheels [rad], which the loop measures in whole encoder ticks.
            speed: speeds of the wheels [rad/s], for the back-EMF.
        """
        m = self.motor
        ticks = [floor(a / self._per_tick) for a in angle]
        before = self._ticks or ticks
        self._ticks = ticks
        out = []
        drawn = 0.0
        for k, target in enumerate(wanted):
            measured = (ticks[k] - before[k]) * self._per_tick / self.dt
            self._speed[k] += self._blend * (measured - self._speed[k])
            volts = self._voltage(k, target * self.gear, self._speed[k] * self.gear)
            turning = speed[k] * self.gear
            settled = (volts - m.back_emf_vs * turning) / m.resistance_ohm
            amps = settled + (self.current[k] - settled) * self._decay
            torque = self.gear * m.back_emf_vs * 0.5 * (amps + self.current[k])
            self.voltage[k], self.current[k] = volts, amps
            drawn += amps * volts / self.bus
            out.append(torque * m.efficiency if torque * turning > 0 else torque)
        self.bus = max(m.supply_v - m.supply_ohm * max(drawn, 0.0), 0.05 * m.supply_v)
        return out

    def _voltage(self, k: int, wanted: float, measured: float) -> float:
        """Return the loop's voltage for motor `k`, limited to the bus voltage [V].

        While a limit is active, the integral keeps its value (anti-windup).
        """
        loop, m = self.loop, self.motor
        error = wanted - measured
        stored = self._integral[k] + loop.integral * error * self.dt
        if loop.kind == "pi":
            volts = loop.gain * error + stored
        elif loop.kind == "feed_forward":
            volts = loop.gain * error + m.back_emf_vs * wanted
        else:
            amps = loop.gain * error + stored
            held = min(max(amps, -loop.current_limit_a), loop.current_limit_a)
            stored = stored if held == amps else self._integral[k]
            volts = (
                m.resistance_ohm * held
                + m.back_emf_vs * measured
                + loop.current_gain * (held - self.current[k])
            )
        limited = min(max(volts, -self.bus), self.bus)
        if limited == volts:
            self._integral[k] = stored
        return limited
