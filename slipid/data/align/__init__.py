"""Alignment: lag, clock offset and drift between poses and a robot's own sensors."""
