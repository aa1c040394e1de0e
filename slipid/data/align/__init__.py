"""Alignment in time of poses with a robot's own sensors: lag, clock offset and drift."""
