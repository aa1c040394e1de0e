"""Slip models: one interface, open-loop prediction, scores, ranking."""
