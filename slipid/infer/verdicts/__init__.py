"""Verdicts on fits: identified parameters, flat directions, disputed loads, trust in a fit."""
