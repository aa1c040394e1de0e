"""Whether commanded and reported wheel speeds are of the wheels that the encoders say, run by run.

Poses tell which columns are right where all runs have the same mistake. Here one channel of the
wheels is compared with another, which needs neither poses nor a geometry, and one run is enough.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from slipid.data.log import Log
from slipid.data.sanity.finding import Finding
from slipid.data.wheel_signals import integral, interpolate, swapped_order
from slipid.support.errors import DataError

SAME = ("wheel_sign", "wheel_order", "command_sign", "command_order")
"""Findings from the poses of all runs together, which say it better."""
BROUGHT = ("wheel_scale", "wheel_speed_unit")
"""Findings that columns in another order may bring about; with the right order they are told."""
STEP_S = 0.5
"""Length of a step [s]: delays and jitter do not matter."""
CHANNELS = ("wheel_speed_command", "wheel_speed")
"""That are compared with the encoders."""


def misordered(logs: Sequence[Log]) -> Iterator[Finding]:
    """A finding for every channel and every order in which its columns are those of the wheels."""
    found: dict[tuple[str, tuple[int, ...]], list[str]] = {}
    for log in logs:
        for name, order in _orders(log):
            found.setdefault((name, order), []).append(log.name)
    for (name, order), names in found.items():
        listed = ", ".join(map(str, order))
        yield Finding(
            "wheel_columns",
            f"the wheels move as their {name} says only if their columns are taken in the order "
            f"{listed}, where those below zero count backwards",
            f"list the columns of the wheels, or those of {name}, in another order, or set "
            "scale = -1 for those that count backwards",
            "wrong",
            () if len(names) == len(logs) else tuple(names),
        )


def refuse_misordered(logs: Sequence[Log]) -> None:
    """DataError with all findings, for commands that look for no other mistakes."""
    if said := "\n".join(f"not used: {finding}" for finding in misordered(logs)):
        raise DataError(said)


def _orders(log: Log) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Channels of a run whose columns are those of the wheels in another order, and that order."""
    edges = np.linspace(log.time[0], log.time[-1], max(2, int(log.duration / STEP_S) + 1))
    measured: Float[np.ndarray, "step wheel"] | None = None
    for name in CHANNELS:
        rate = getattr(log, name)
        if rate is None:
            continue
        if measured is None:
            measured = np.diff(interpolate(log.time, log.wheel_angle, edges), axis=0)
        said = np.diff(interpolate(log.time, integral(log.time, rate), edges), axis=0)
        if order := swapped_order(measured, said):
            yield name, order
