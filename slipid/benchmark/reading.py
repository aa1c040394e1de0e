"""A plain reading of the tables: where slipid is ahead, where it is not, and by how much."""

from collections.abc import Mapping

from slipid.benchmark.own import NAME
from slipid.benchmark.summary import Number, RowSummary

NAMED = 4
"""Rows that a sentence names."""


def reading(tables: Mapping[str, Mapping[str, Mapping[str, RowSummary]]]) -> list[str]:
    """A sentence for each protocol of each data set."""
    return [
        sentence(name, protocol, found)
        for name, protocols in tables.items()
        for protocol, found in protocols.items()
    ]


def sentence(name: str, protocol: str, found: Mapping[str, RowSummary]) -> str:
    """What the end-point errors of one table say of slipid."""
    head = f"{name}, {protocol.replace('_', ' ')}: "
    own = found.get(NAME)
    errors = {row: s.endpoint_error for row, s in found.items() if s.endpoint_error is not None}
    if own is None or own.endpoint_error is None:
        why = "was not asked" if own is None else own.absent
        return f"{head}slipid has no row ({why})"
    mine = _percent(own.endpoint_error)
    others = {row: error for row, error in errors.items() if not row.startswith(NAME)}
    if not others:
        return f"{head}slipid errs by {mine}; nothing to compare it with"
    ahead = {row: b for row in others if (b := found[row].behind) is not None and b.high < 0}
    tied = [row for row in others if (b := found[row].behind) is not None and b.low <= 0 <= b.high]
    if ahead:
        best = min(ahead, key=lambda row: others[row].value)
        also = f" (and {len(ahead) - 1} more)" if len(ahead) > 1 else ""
        return (
            f"{head}{best}{also} is ahead of slipid: {_percent(others[best])} against {mine}, "
            f"{_points(ahead[best])}"
        )
    best = min(others, key=lambda row: others[row].value)
    said = f"{head}slipid errs by {mine}, the best other row, {best}, by {_percent(others[best])}"
    if tied:
        tied.sort(key=lambda row: others[row].value)
        more = f" and {len(tied) - NAMED} more" if len(tied) > NAMED else ""
        return f"{said}; not told apart from {', '.join(tied[:NAMED])}{more}"
    behind = found[best].behind
    return f"{said}, {_points(behind)}" if behind is not None else said


def _percent(x: Number) -> str:
    return f"{100 * x.value:.1f} %"


def _points(x: Number) -> str:
    """A difference in points of percent, with its interval."""
    return f"{100 * x.value:+.1f} points [{100 * x.low:+.1f}, {100 * x.high:+.1f}]"
