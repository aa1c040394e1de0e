"""The reference of configs is complete, has one source, and equals docs/config.md."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import pytest
from pydantic import BaseModel, Field

from slipid.app import config as c
from slipid.app.config import read_config
from slipid.app.reference.keys import (
    in_short,
    in_words,
    keys,
    keys_of,
    meaning,
    parameter_rows,
    prior,
    purpose,
)
from slipid.app.reference.page import CHAPTERS, reference
from slipid.data.reading.bag.layout import RunRule, TopicChannel
from slipid.data.reading.layout import CHANNELS, Channel, Layout
from slipid.data.reading.presets import PRESETS
from slipid.data.reading.units import KNOWN
from slipid.model.geometry import omni
from slipid.model.robot import Robot
from slipid.parameter import Declaration, entries
from slipid.support.errors import DataError

ROOT = Path(__file__).resolve().parents[2]
MODELS = (
    *(
        c.ConfigContent,
        c.OmniDrive,
        c.FourWheelDrive,
        c.DifferentialDrive,
        c.SteeredDrive,
        c.GeneralDrive,
        c.BenchMotors,
        c.LogsSection,
        c.CameraSection,
        c.PriorSection,
        c.ParameterSection,
    ),
    *(
        c.WeightsSection,
        c.FitSection,
        c.ValidateSection,
        c.SelftestSection,
        Layout,
        Channel,
        TopicChannel,
        RunRule,
    ),
)


def test_docs_are_what_the_command_writes():
    written = (ROOT / "docs" / "config.md").read_text(encoding="utf-8")
    assert written == reference(), "run: slipid reference > docs/config.md"


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_every_key_is_explained_where_it_is_declared(model):
    for key in keys(model).values():
        if key != "drive":
            assert len(meaning(model, key)) > 5, key
    assert all(key.kind for key in keys_of(model))
    assert purpose(model)


def test_a_key_without_a_word_is_found_out():
    class Silent(BaseModel):
        """It says nothing of its key."""

        key: int = 0

    with pytest.raises(KeyError, match="Silent has no attribute line for 'key'"):
        keys_of(Silent)


@dataclass
class Sample:
    """A sample.

    More of it.

    Attributes:
        one: goes on
            in a second line; with more.
        two, three: shared.
        four: here; five: there.
    """

    one: int
    two: int
    three: int
    four: int
    five: int


def test_attribute_lines_are_read():
    assert meaning(Sample, "one") == "goes on in a second line; with more."
    assert in_short(Sample, "one") == "goes on in a second line"
    assert meaning(Sample, "three") == "shared."
    assert (meaning(Sample, "four"), meaning(Sample, "five")) == ("here", "there.")
    assert purpose(Sample) == "A sample. More of it."


@pytest.mark.parametrize(
    ("hint", "words"),
    [
        (Annotated[float, Field(gt=0)], "number > 0"),
        (float | None, "number"),
        (Literal["a", "b"], '"a" or "b"'),
        (list[Annotated[float, Field(gt=0)]], "list of (number > 0)"),
        (tuple[float, float], "list of 2 numbers"),
        (dict[str, bool], "table of (true or false)"),
        (bool, "true or false"),
    ],
)
def test_types_in_words(hint, words):
    assert in_words(hint) == words


def test_all_there_is_is_in_it():
    text = reference()
    for name in (*CHANNELS, *KNOWN, *PRESETS):
        assert f"`{name}`" in text, name
    robot = Robot.of(omni([60.0, 180.0, 300.0], 0.125, 0.04)).on(("FLOOR",), sessions=("SESSION",))
    for entry in entries(robot):
        assert f"| `{entry.path}` |" in text
        assert entry.declaration.doc
    for drive in ("omni", "mecanum", "skid", "differential", "steered", "general", "motor"):
        assert f'drive = "{drive}"' in text


def test_parts_by_name():
    whole = reference()
    for name in CHAPTERS:
        assert reference(name).strip() in whole
    with pytest.raises(DataError, match=r"'chanels', did you mean channels\?; expected one of"):
        reference("chanels")


def test_parameters_of_a_config_say_what_it_wants():
    rows = {row.path: row for row in parameter_rows(read_config(ROOT / "configs" / "husky.toml"))}
    assert rows["robot.radius_deviation"].size == 2
    assert rows["robot.drive_offset"].size == 4
    assert rows["surface.wet_grass.creep"].here == "prior 0.1 +- 0.05"
    assert rows["motor.resistance"].here == "not fitted"
    assert rows["surface.wet_grass.scrub"].here == ""


@pytest.mark.parametrize(
    ("declared", "words"),
    [
        ({"lower": 0.0, "spread": 0.5}, "log-normal, log-std 0.5"),
        ({"lower": 1.0, "spread": 0.5}, "log-normal above 1, log-std 0.5"),
        ({"spread": 0.1, "free": False}, "not fitted; if free: normal, std 0.1"),
        ({"lower": 0.0, "upper": 1.0}, "between 0 and 1, std 1 in log-odds"),
        ({"shares": True, "spread": 0.5}, "shares around an even load, log-std 0.5"),
    ],
)
def test_priors_in_words(declared, words):
    assert prior(Declaration(unit="1", symbol="x", start=0.5, **declared)) == words
