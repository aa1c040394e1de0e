"""Section about feed-forward gains, and the feedback gains that belong to them."""

from collections.abc import Sequence

from slipid.report.gains import EQUATION, HEAD, feedback_sentences, gain_rows
from slipid.report.html.blocks import Block, Cell, PageSection, TableBlock, TextBlock, badge
from slipid.report.html.results import Results
from slipid.support.content import Content

ABOUT = (
    f"Voltage for a wanted speed w and acceleration: {EQUATION}. kS overcomes dry friction; "
    "at standstill it has the sign of the acceleration."
)
ROBOT = (
    "Speeds are those of a wheel, and a metre is one that its rim rolls. linear and linear_y "
    "are gains for motion ahead and to the left, angular those for turning; their kA differ by "
    "the inertia that a motor moves. Add to kS what a floor itself resists."
)
"""Sentences about gains of a robot."""


def gains(found: Results) -> PageSection | None:
    """Return the section about the gains of a robot, None if it has none."""
    return gains_section(found.identified, ROBOT)


def gains_section(content: Content, more: str = "") -> PageSection | None:
    """Return the section about the gains in a result file, None if it has none."""
    rows: list[Sequence[Cell]] = [
        (
            f"{row.name}: {row.gain}",
            *(row.value, row.unit, row.interval90.replace(" .. ", " to ")),
            *(badge(row.verdict), row.per_rotation, row.per_metre),
        )
        for row in gain_rows(content.get("feedforward", {}))
    ]
    if not rows:
        return None
    sentences = [one[0].upper() + one[1:] for one in feedback_sentences(content["feedback"])]
    blocks: list[Block] = [
        TextBlock([ABOUT, more]),
        TableBlock("Feed-forward gains.", HEAD, rows, ("value", *HEAD[-2:])),
        TextBlock(sentences, listed=True),
    ]
    return PageSection("feedforward", "Feed-forward gains", blocks)
