"""Trusted lengths, and the lag that the motion shows, unless the config decides otherwise."""

import re
from pathlib import Path

import pytest

from slipid.app.config import parsed
from slipid.app.problem import ConfigFitTask, read_fit_task
from slipid.search_space import Space
from slipid.support.errors import DataError
from slipid.support.progress import Reporter
from tests.helpers.plain_config import config


def job(folder: Path, more: str) -> ConfigFitTask:
    file = config(folder)
    text = file.read_text(encoding="utf-8") + more
    with Reporter(quiet=True) as report:
        return read_fit_task(parsed(file, text), folder / "logs", report)


def free(made: ConfigFitTask) -> set[str]:
    return {e.path for e in Space(made.robot, made.choices).free}


@pytest.mark.parametrize(
    ("trusted", "freed"), [("poses", "robot.wheel_radius"), ("wheels", "camera.scale")]
)
def test_the_other_length_is_free(tmp_path, trusted, freed):
    found = free(job(tmp_path, f'[fit]\nlengths_from = "{trusted}"\n'))
    assert found & {"robot.wheel_radius", "camera.scale"} == {freed}


def test_neither_is_free_by_default(tmp_path):
    assert not free(job(tmp_path, "")) & {"robot.wheel_radius", "camera.scale"}


def test_both_at_once_are_refused(tmp_path):
    more = '[fit]\nlengths_from = "poses"\n[parameters]\n"camera.scale" = { free = true }\n'
    with pytest.raises(DataError, match=re.escape("fit.lengths_from = 'poses' with camera.scale")):
        job(tmp_path, more)


def test_a_lag_that_nobody_gave_is_found_and_one_that_is_given_stands(tmp_path):
    """The made robot's poses are 0.06 s late."""
    found = job(tmp_path, "")
    assert "camera.lag" in free(found)
    start = float(Space(found.robot, found.choices).template.camera.lag)
    assert start == pytest.approx(0.06, abs=0.03)
    given = job(tmp_path, '[parameters]\n"camera.lag" = { fixed = 0.5 }\n')
    assert float(Space(given.robot, given.choices).template.camera.lag) == 0.5
