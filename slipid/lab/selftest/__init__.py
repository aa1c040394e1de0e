"""Simulated logs with known true parameters, and the comparison of their fits with the truth."""
