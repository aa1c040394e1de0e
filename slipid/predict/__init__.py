"""Slip models: their common interface, open-loop prediction, scores, and ranking."""
