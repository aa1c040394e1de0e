"""Layouts and configs with values of any kind at any place are read, or refused in a sentence."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from slipid.app.config import geometry, parsed
from slipid.data.reading.bag.layout import declared_bag_layout
from slipid.data.reading.presets import declared_layout
from slipid.support.errors import DataError
from tests.fuzz import config_doors, hostile, log_doors
from tests.fuzz.case import too_long
from tests.fuzz.door import wrong_number

_SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=30)
_VALUES = st.recursive(
    _SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=8,
)


def changed(content: dict[str, Any]) -> st.SearchStrategy[dict[str, Any]]:
    """Contents of which one or two values are any others."""
    places = st.lists(st.sampled_from(hostile.paths_of(content)), min_size=1, max_size=2)

    @st.composite
    def made(draw: Callable[..., Any]) -> dict[str, Any]:
        out = copy.deepcopy(content)
        for *above, key in draw(places):
            here = out
            try:
                for step in above:
                    here = here[step]
                here[key] = draw(_VALUES)
            except (KeyError, IndexError, TypeError):  # the first change took it away
                continue
        return out

    return made()


def fault_of(read: Callable[[], Any]) -> str | None:
    """Return the fault of a reader: a long refusal, or a wrong number in what it read."""
    try:
        return wrong_number(read())
    except DataError as error:
        return str(error) if too_long(str(error)) else None


many = settings(
    max_examples=150, deadline=None, derandomize=True, suppress_health_check=[*HealthCheck]
)


@many
@given(changed(log_doors.TWO_FILES))
def test_layouts_of_rows(content):
    assert fault_of(lambda: declared_layout(content, "layout")) is None


@many
@given(changed(log_doors.BAG | {"runs": {"pause_s": 0.3}}))
def test_layouts_of_bags(content):
    assert fault_of(lambda: declared_bag_layout(content, "layout", Path())) is None


@many
@given(changed(hostile.read(".toml", config_doors.ROBOT.encode())))
def test_configs(content):
    text = hostile.written(".toml", content).decode()

    def read() -> Any:
        found = parsed(Path("my.toml"), text).content
        return found, geometry(found.wheels)

    assert fault_of(read) is None


def test_unchanged_contents_are_read():
    config = hostile.read(".toml", config_doors.ROBOT.encode())
    assert declared_layout(log_doors.TWO_FILES, "layout").beside
    assert declared_bag_layout(log_doors.BAG, "layout", Path()).joints
    text = hostile.written(".toml", config).decode()
    assert parsed(Path("my.toml"), text).content.logs
