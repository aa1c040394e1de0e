"""Classifiers of the floor from wheel speeds, currents and a gyro, without a pose."""
