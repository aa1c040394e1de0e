"""What could not be checked, for want of channels or of motion."""

from collections.abc import Iterator

import numpy as np

from slipid.data.sanity.axes.reading import Evidence, Reading, to_body
from slipid.data.sanity.finding import Finding
from slipid.data.sanity.motion.recorded import Flat, Recorded
from slipid.data.sanity.scales.ratios import FORWARD, TURNS


def notes(data: Recorded, evidence: Evidence, reading: Reading) -> Iterator[Finding]:
    """A note for everything that the runs leave open."""
    yield from _unmoved(evidence, reading)
    if evidence.twist is None and evidence.command is None:
        yield not_checked(
            "no command is logged: wheels that are said to turn too far cannot be told from wheels "
            "that slip"
        )
    if data.current is not None and not data.current_is_signed:
        yield not_checked("currents are magnitudes: their signs cannot be checked")
    if _constant(data.gyro):
        yield not_checked("the gyro never changes: it cannot be checked")


def not_checked(what: str) -> Finding:
    """The note that something was not checked."""
    return Finding("not_checked", what, None, "note")


def _unmoved(evidence: Evidence, reading: Reading) -> Iterator[Finding]:
    """Directions in which no run moves."""
    pose = next(iter(evidence.pose.values()), None)
    if pose is None:
        return
    predict = to_body(evidence, reading)
    share = np.einsum("aw,wv,av->a", predict, pose.turns, predict)
    share = share / max(float(share.sum()), 1e-300)
    if share[2] < TURNS:
        yield not_checked("no run turns: base radius, unit of the heading and gyro are unchecked")
    if share[0] < FORWARD:
        yield not_checked("no run drives ahead: order and signs are checked in part only")
    if evidence.free and share[1] < FORWARD:
        yield not_checked("no run drives sideways: order and signs are checked in part only")


def _constant(channel: Flat | None) -> bool:
    """Whether a channel never changes."""
    return channel is not None and not np.nanmax(np.abs(np.diff(channel.value, axis=0))) > 0
