"""Classifiers that tell the floor from wheel speeds, currents and a gyro, without a pose."""
