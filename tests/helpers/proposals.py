"""Configs that are proposed for logs, and the runs that are read with them."""

from __future__ import annotations

import tomllib
from pathlib import Path

from slipid.app.config import parsed
from slipid.app.logs import read_dataset
from slipid.app.new.config_text import new_config
from slipid.app.new.propose import propose
from tests.helpers.made_tables import RADIUS, TRACK
from tests.helpers.said import KeptMessages

ROBOT = {
    "drive": "differential",
    "track_m": str(TRACK),
    "wheel_radius_m": str(RADIUS),
    "gear_ratio": "1",
    "mass_kg": "20",
}


def proposed(path: Path, **told: str):
    draft = propose(path, told)
    return draft, new_config(draft, "mine.toml")


def layout_in(config, name: str = "mine"):
    return tomllib.loads(config.text)["layouts"][name]


def read(config, root: Path):
    """Runs as `slipid check` reads them."""
    there = parsed(Path("mine.toml"), config.text)
    data, skipped = read_dataset(there, there.content.logs, root, KeptMessages())
    assert not skipped
    return data
