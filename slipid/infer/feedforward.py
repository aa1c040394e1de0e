"""Feed-forward gains of motors on a bench, from fitted numbers and their covariance."""

from collections.abc import Mapping

import numpy as np

from slipid.infer.bench.fit import MotorFit
from slipid.infer.bench.verdict import BenchFit
from slipid.infer.verdicts.estimates import Estimate
from slipid.model.feedforward import DriveNumbers, Feedforward, Gain, Known, feedforward, useful


def bench_feedforwards(found: BenchFit) -> tuple[Feedforward, ...]:
    """Return the gains of each motor whose resistance and back-EMF are known well enough.

    Their names are the labels of the motors, or `motor` for a single motor without a label.
    """
    each = (motor_feedforward(fit, found.parameters) for fit in found.fits)
    return tuple(one for one in each if one is not None)


def motor_feedforward(fit: MotorFit, parameters: Mapping[str, Estimate]) -> Feedforward | None:
    """Return the gains at a motor's shaft; None if resistance or back-EMF are hardly known.

    Without a current, they are those of the voltage, and include kG if it differs from 0.

    Args:
        fit: fit of the motor.
        parameters: estimates with their verdicts, keyed by path, which ends in `@label` if the
            motor has a label.
    """
    end = f"@{fit.label}" if fit.label else ""
    if not fit.has_current:
        kS, kV, kA, kG = (_gain(parameters[f"motor.{k}{end}"]) for k in ("kS", "kV", "kA", "kG"))
        return Feedforward(fit.label or "motor", kS, kV, kA, kG if _lifts(kG) else None)
    paths = {name: f"motor.{name}" for name in DriveNumbers._fields}
    used = {name: path for name, path in paths.items() if path + end in parameters}
    numbers = {name: _known(parameters[path + end]) for name, path in used.items()}
    if not useful(numbers["resistance"], numbers["back_emf"]):
        return None
    correlation, slices = np.eye(len(used)), fit.space.slices
    fitted = [k for k, path in enumerate(used.values()) if path in slices]
    places = [slices[path].start for path in used.values() if path in slices]
    std = np.sqrt(np.diag(fit.covariance))
    scaled = fit.covariance / std / std[:, None]
    correlation[np.ix_(fitted, fitted)] = scaled[np.ix_(places, places)]
    return feedforward(fit.label or "motor", numbers, correlation)


def _gain(e: Estimate) -> Gain:
    return Gain(e.value, e.unit, e.std, e.interval90, e.verdict)


def _lifts(gain: Gain) -> bool:
    """Return True if the interval of a voltage against gravity does not contain 0."""
    return gain.interval90 is not None and (gain.interval90[0] > 0 or gain.interval90[1] < 0)


def _known(e: Estimate) -> Known:
    return Known(e.value, 0.0 if e.std is None else e.std, e.verdict)
