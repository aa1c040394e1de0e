"""Verdicts: identified numbers, flat directions, disputes and trust in a fit."""
