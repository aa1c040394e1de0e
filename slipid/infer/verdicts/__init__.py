"""Verdicts: what a fit knows and what it does not."""
