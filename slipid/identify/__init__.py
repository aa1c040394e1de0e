"""Likelihood, staged fit, intervals and verdicts."""
