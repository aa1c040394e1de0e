"""DC motors on one supply, and the speed loop that is built into the robot."""

from math import exp, floor, pi
from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from slipid.support.toml_file import CLOSED, NotNegative, Positive


@dataclass(frozen=True, config=CLOSED)
class Motor:
    """A brushed DC motor with its gear.

    Attributes:
        resistance_ohm, inductance_h: resistance and inductance of the winding.
        back_emf_vs: [V s/rad], which is its torque per current as well.
        rotor_inertia_kg_m2: at the motor shaft.
        coulomb_nm, viscous_nms: friction at the wheel [N m], [N m s].
        efficiency: efficiency of the gear while the motor drives.
        supply_v, supply_ohm: voltage and resistance of the battery that all motors share; its
            voltage never falls below a twentieth.
        ticks_per_revolution: ticks of the encoder in one turn of the motor shaft.
    """

    resistance_ohm: Positive = 5.5
    inductance_h: Positive = 8.9e-3
    back_emf_vs: Positive = 0.0514
    rotor_inertia_kg_m2: Positive = 7.1e-6
    coulomb_nm: NotNegative = 0.07
    viscous_nms: NotNegative = 0.006
    efficiency: Annotated[float, Field(gt=0, le=1)] = 0.9
    supply_v: Positive = 24.0
    supply_ohm: NotNegative = 0.15
    ticks_per_revolution: Annotated[int, Field(ge=10)] = 2000


@dataclass(frozen=True, config=CLOSED)
class SpeedLoop:
    """The built-in controller of wheel speed, at the engine's time step.

    Attributes:
        kind: `pi`; `feed_forward` (proportional, and the back-EMF of the wanted speed); `cascade`
            (PI to a current, and a current loop below it).
        gain: gain of the error in motor speed [V s/rad]; in a cascade [A s/rad].
        integral: per second of it [V/rad]; in a cascade [A/rad].
        current_gain: gain of the cascade's inner loop [V/A].
        current_limit_a: limit of the cascade's current.
        filter_s: time constant of the measured speed.
    """

    kind: Literal["pi", "feed_forward", "cascade"] = "pi"
    gain: NotNegative = 0.08
    integral: NotNegative = 0.8
    current_gain: NotNegative = 4.0
    current_limit_a: Positive = 3.0
    filter_s: NotNegative = 0.004


class Drive:
    """Currents [A] and voltages [V] of all wheels, a step of `dt` [s] at a time."""

    def __init__(self, motor: Motor, loop: SpeedLoop, gear_ratio: float, wheels: int, dt: float):
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
        """Torques at the wheels [N m] over one step.

        Args:
            wanted: wheel speeds [rad/s].
            angle: angles of the wheels [rad]; the loop sees whole ticks of it.
            speed: speeds of the wheels [rad/s], for the back-EMF.
        """
        m = self.motor
        ticks = [floor(a / self._per_tick) for a in angle]
        before = self._ticks or ticks
        self._ticks = ticks
        out = []
        drawn = 0.0
        for k, target in enumerate(wanted):
            seen = (ticks[k] - before[k]) * self._per_tick / self.dt
            self._speed[k] += self._blend * (seen - self._speed[k])
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
        """The loop's wish within the bus voltage; where that ends the integral is held."""
        loop, m = self.loop, self.motor
        error = wanted - measured
        stored = self._integral[k] + loop.integral * error * self.dt
        if loop.kind == "pi":
            wish = loop.gain * error + stored
        elif loop.kind == "feed_forward":
            wish = loop.gain * error + m.back_emf_vs * wanted
        else:
            amps = loop.gain * error + stored
            held = min(max(amps, -loop.current_limit_a), loop.current_limit_a)
            stored = stored if held == amps else self._integral[k]
            wish = (
                m.resistance_ohm * held
                + m.back_emf_vs * measured
                + loop.current_gain * (held - self.current[k])
            )
        volts = min(max(wish, -self.bus), self.bus)
        if volts == wish:
            self._integral[k] = stored
        return volts
