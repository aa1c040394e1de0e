"""Proposals of the next runs to drive."""
