"""Quann and others' Gaussian processes: slip from what is measured, energy from places."""
