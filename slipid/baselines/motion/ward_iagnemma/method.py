"""Ward and Iagnemma detect slip by an extended Kalman filter on the robot's dynamics.

The state is the body's twist v, the coefficient rho of the resistive force and the gyro's bias b.
Wheel speeds are inputs. Let q = (vx, vy, L W), let J_i be the rim speed of drive i per q, let
N = m g / n be the load of each of n drives, and let M = diag(m, m, m/2), p = (vx, vy) and
q_t = L W. Then the forces and the equation of motion are

    u_i    = r w_i - J_i q                                              sliding speed
    T_i    = N (C1 sgn(u_i) (1 - exp(-A |u_i|)) + C2 u_i)               traction
    F      = - m g rho (1 / sqrt(|p|^2 + v_s^2) + c) p                  resistive force on travel
             - m g rho_t q_t / sqrt(|q_t|^2 + v_s^2)                    and on turning
    M dq/dt = sum_i J_i^T T_i + F + m W (vy, -vx, 0)

Wheels that do not determine the twist (skid steer) grip sideways, and they slide sideways as soon
as the robot turns; then p = vx and q_t = (vy, L W). A step is one of backward Euler, solved by
Newton's method with the analytic Jacobian. The filter measures gyro = W + b, and in
`ward_iagnemma_current` also n C_e I_i / r = k sgn(w_i) T_i + f of every wheel that drives. A weak
constraint keeps rho in its range: where rho is below 0, so that the force would push, or above
C1 / (1 + c |p|), so that no traction could overcome it, a measurement with a tenth of rho's spread
pulls it to that bound.

A robot is called immobilised where |v| < 0.2 of what its wheels say, for 0.4 s. The score of
slipping is 1 - |v| / |v by the wheels|, where turning is weighted by the base radius.

The fit uses at most 40 runs. It finds A, rho, rho_t and c by least squares of the twists of windows
of half a second, each as if the robot had always driven like that. From what is left it then takes
how rho scatters between runs, the process noise (white noise of the twist that explains where
training runs end), the noise and bias of the gyro, and k, f and the noise of the currents. Two
settings are tuned: whether resistance grows with speed (c), and whether rho wanders within a run,
by half its scatter between runs in a second.

Liberties:
- The original measures acceleration and, where there is one, GPS; neither is logged here. It has
  one axis of travel and pitch; here the body moves in a plane, and the ground is level.
- The state is the coefficient of the resistive force, not the force. The force fades out within
  v_s = 2 cm/s of rest, and may grow with speed (c); turning has a coefficient of its own.
- The original takes parameters from experiments and shows that their values matter little; here
  they are fitted. At steady speed motion tells forces only in ratio to C1, so C1 is 0.6 throughout.
  C2 is 0.1 s/m, since windows cannot tell it from the end of the exponential. A weak prior holds
  the other parameters where motion does not tell them.
- Every drive carries the same load, traction acts along the drive direction only (rollers are
  free), and the inertia is m L^2 / 2.
- Forces by currents are scaled and offset by least squares (k, f), because gear losses are not
  known, and often not even the motor. Their errors are mostly the same all along a run, so their
  noise is that of the mean of a run. They correct rho, and through it the twist, but they do not
  correct the twist itself: most of its scatter is no sliding, and the steep law would take it for
  that. Where ammeters have no sign, all driving wheels are taken to push. Wheels below 0.3 of the
  fastest rim speed are not heard.
- A run starts as if nothing had slipped.
- The score is the ratio itself, without waiting for 0.4 s.
- The pose is not corrected by later measurements: the path is that of the filtered twists, and
  its covariance is of that path (a Kalman filter whose gain for the pose is zero).

Source: Ward & Iagnemma 2008, "A dynamic-model-based wheel slip detector for mobile robots on
outdoor terrain", IEEE Transactions on Robotics 24(4).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np

from slipid.baselines.motion.ward_iagnemma.dynamics import REST, Dynamics, Law
from slipid.baselines.motion.ward_iagnemma.filter import Filter, Noise
from slipid.baselines.motion.ward_iagnemma.fit import Windows, fitted_law, fitted_noise
from slipid.baselines.motion.ward_iagnemma.padded import Padded
from slipid.identify.compare.slip_model import Heard, Machine, Run, Said, SlipModel, path_of


@final
@dataclass(frozen=True)
class WardIagnemma(SlipModel):
    """The filter, with or without currents.

    Attributes:
        with_drag: whether resistance grows with speed.
        wander: by how much of its scatter between runs rho moves in a second of a run.
        law, noise: fitted.
    """

    name: str = "ward_iagnemma"
    with_drag: bool = True
    wander: float = 0.0
    law: Law = field(default_factory=Law)
    noise: Noise = field(default_factory=Noise)

    @classmethod
    def with_current(cls) -> "WardIagnemma":
        """The variant that measures traction by the currents."""
        return cls("ward_iagnemma_current", needs=frozenset({"current"}))

    def candidates(self) -> Sequence["WardIagnemma"]:
        return [replace(self, with_drag=d, wander=w) for d in (False, True) for w in (0.0, 0.5)]

    def fit(self, runs: Sequence[Run], machine: Machine) -> "WardIagnemma":
        windows = Windows.of(runs, machine)
        law = fitted_law(windows, machine, self.with_drag)
        noise = fitted_noise(windows, Dynamics.of(machine, law), machine.mass)
        return replace(self, law=law, noise=noise)

    def predict(self, runs: Sequence[Heard], machine: Machine) -> list[Said]:
        padded = Padded.of(runs, machine)
        tracked = self.filter(machine).track(padded)
        size, fastest = (np.linalg.norm(q, axis=2) for q in (tracked.speeds, padded.rolling))
        kept = np.where(fastest > REST, size / np.where(fastest > REST, fastest, 1.0), 1.0)
        slipping = np.clip(1.0 - kept, 0.0, 1.0)
        return [
            Said(
                path_of(tracked.speeds[k, : len(run)] / machine.size, run.dt),
                end_covariance=tracked.covariance[k, :2, :2],
                slipping=slipping[k, : len(run)],
            )
            for k, run in enumerate(runs)
        ]

    def filter(self, machine: Machine) -> Filter:
        """The filter as fitted, for a robot."""
        return Filter(
            dynamics=Dynamics.of(machine, self.law),
            noise=self.noise,
            mass=machine.mass,
            hears_current="current" in self.needs,
            wander=self.wander * self.noise.rolling,
        )

    @property
    def numbers(self) -> int:
        heard = 2 * np.isfinite(self.noise.gyro) + 3 * ("current" in self.needs)
        return 3 + self.with_drag + 4 + int(heard)
