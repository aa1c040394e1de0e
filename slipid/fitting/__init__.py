"""Likelihood of windows and its maximum."""
