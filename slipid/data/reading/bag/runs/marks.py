"""Runs by a topic whose value marks them."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import numpy as np

from slipid.data.reading.bag.layout import BagLayout, RunRule
from slipid.data.reading.bag.messages.picks import STAMPS
from slipid.data.reading.bag.messages.shape import Shape, shape_of, steps_of
from slipid.data.reading.bag.messages.streams import topic_error
from slipid.data.reading.bag.plan import message_of
from slipid.data.reading.bag.runs.stretch import Stretch
from slipid.data.reading.bag.storage.opened import OpenBag
from slipid.support.errors import near

Value = str | float


@dataclass(frozen=True)
class _Mark:
    """What one message says: when [s], its value, and the floor and the load it names."""

    time: float
    value: Value
    surface: str | None
    load: str | None

    @property
    def told(self) -> tuple[Value, str | None, str | None]:
        """All but the time."""
        return self.value, self.surface, self.load


def by_topic(bag: OpenBag, layout: BagLayout, rule: RunRule) -> list[Stretch]:
    """A run as long as the value of a topic stays, but for values between runs.

    Raises:
        DataError: the topic or a field is missing.
    """
    found: list[Stretch] = []
    start: _Mark | None = None
    for mark in (*_marks(bag, layout, rule), None):
        if start is not None and mark is not None and mark.told == start.told:
            continue
        if start is not None and start.value not in rule.between:
            end = inf if mark is None else mark.time
            found.append(Stretch(start.time, end, "", start.surface, start.load))
        start = mark
    return found


def _marks(bag: OpenBag, layout: BagLayout, rule: RunRule) -> list[_Mark]:
    """Every message of the topic in order of time."""
    name = str(rule.topic)
    message = message_of(bag, layout, name, "runs")
    for path in (rule.field, rule.surface, rule.load):
        plain = ".".join(step.name for step in steps_of(path)) if path else None
        if plain is not None and plain not in message.paths:
            found = f"no field '{path}' in {message.name}{near(path, message.paths)}"
            raise topic_error(bag.path, name, found, f"one of {', '.join(message.paths)}")
    marks = []
    for number, raw in enumerate(bag.messages((name,)), start=1):
        try:
            shape = shape_of(raw.data, message, cdr=bag.cdr)
            value = _value(shape, raw.data, rule.field)
        except ValueError as error:
            expected = "messages as their definition says; is the bag damaged?"
            raise topic_error(bag.path, name, str(error), expected, number) from error
        surface, load = (_text(shape, path) for path in (rule.surface, rule.load))
        own = _stamp(shape, raw.data) if layout.stamp == "header" else None
        marks.append(_Mark((raw.received if own is None else own) / 1e9, value, surface, load))
    return sorted(marks, key=lambda mark: mark.time)


def _value(shape: Shape, raw: bytes, path: str) -> Value:
    """Text or number at a path; ValueError where there is none."""
    steps = steps_of(path)
    if texts := shape.texts(steps):
        return texts[0]
    numbers = shape.places(steps)
    if not numbers:
        raise ValueError(f"nothing in field '{path}'")
    return float(numbers[0].of(_block(raw))[0])


def _text(shape: Shape, path: str | None) -> str | None:
    """Text at a path, None where there is none or it is empty."""
    texts: Sequence[str] = shape.texts(steps_of(path)) if path else ()
    return (texts[0] or None) if texts else None


def _stamp(shape: Shape, raw: bytes) -> int | None:
    """Time of a message itself [ns], None where it has none."""
    for path in STAMPS:
        parts = [shape.places(steps_of(f"{path}.{unit}")) for unit in ("sec", "nanosec")]
        if all(len(places) == 1 for places in parts):
            whole, rest = (int(places[0].whole(_block(raw))[0]) for places in parts)
            return whole * 10**9 + rest
    return None


def _block(raw: bytes) -> np.ndarray:
    return np.frombuffer(raw, np.uint8)[None]
