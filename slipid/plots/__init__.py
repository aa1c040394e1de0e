"""Figures of results, with one module per subject."""

from slipid.support.extras import require

require("matplotlib", "report", "a picture")
