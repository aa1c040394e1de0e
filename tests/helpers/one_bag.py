"""A bag of two wheels, and the one run that is read from it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from slipid.data.reading.bag.layout import BagLayout, declared_bag_layout
from slipid.data.reading.bag.topics import read_bag
from slipid.data.reading.signal import Identity, RawRun
from tests.helpers.made_bags import SUFFIX, Message, in_order, write_bag

TIME = 1.7e9 + np.arange(0.0, 4.0, 0.01)
ANGLE = np.column_stack([3.0 * np.sin(TIME - TIME[0]), np.linspace(0.0, 9.0, len(TIME))])
RESOLUTION = 3e-7
"""Of a double that counts seconds from 1970."""


def layout(joints: tuple[str, ...] = ("left", "right"), **given: Any) -> BagLayout:
    return declared_bag_layout({"kind": "bag", "joints": list(joints), **given}, "layout")


def runs_of(path: Path, layout: BagLayout) -> list[RawRun]:
    return read_bag(Identity("", path, "", None, "as_built"), layout)


def read(path: Path, **given: Any) -> RawRun:
    (run,) = runs_of(path, layout(**given))
    return run


def bag(tmp_path: Path, storage: str, *messages: list[Message], **options: Any) -> Path:
    return write_bag(tmp_path / f"bag{SUFFIX[storage]}", storage, in_order(*messages), **options)
