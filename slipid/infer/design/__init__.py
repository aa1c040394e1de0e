"""Optimal design: proposals of the next runs to drive."""
