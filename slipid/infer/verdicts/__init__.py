"""Verdicts on fits: identified numbers, flat directions, disputed loads, and trust in a fit."""
