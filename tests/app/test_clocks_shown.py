"""Lines of `slipid check` about poses that have a clock of their own."""

from __future__ import annotations

from dataclasses import replace

import pytest

from slipid.app.check import _clock
from slipid.data.align.clock import Clock
from slipid.report.checks import show_check
from slipid.report.page import Page

CLOCK = Clock(
    offset=-1.3,
    offset_std=0.002,
    drift=2e-5,
    drift_std=1e-4,
    middle=4.0,
    unexplained=0.1,
    source="gyro",
)


def shown(*clocks: Clock) -> str:
    names = ("findings", "groups", "channels", "messages")
    content = {name: [] for name in names} | {
        "notes": {},
        "parameters": {},
        "derived": {},
        "settings": {},
    }
    page = Page(kept=True)
    show_check(page, content | {"clocks": {f"run{k}": _clock(c) for k, c in enumerate(clocks)}})
    return " ".join(page.text.split())


def test_offsets_and_their_intervals_are_one_line():
    slow = replace(CLOCK, offset=-1.25, offset_std=0.012, source="wheels")
    text = shown(CLOCK, slow)
    assert "(gyro, wheels): -1.300 to -1.250 s from the robot's in 2 runs" in text
    assert "90 % intervals +- 3.3 to 19.7 ms" in text
    assert "frame rate" not in text


@pytest.mark.parametrize("drift", [1e-3, -1e-3])
def test_implausible_clock_rates_raise_a_question(drift):
    text = shown(CLOCK, replace(CLOCK, drift=drift))
    assert f"differ by up to {1e6 * drift:+.0f} ppm: is the video's frame rate correct?" in text


def test_the_robots_own_clock_needs_no_line():
    assert "clock" not in shown()
