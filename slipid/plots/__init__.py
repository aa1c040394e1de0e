"""Figures of results, with one module per subject."""
