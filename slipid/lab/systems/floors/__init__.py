"""Classifiers of the floor by wheel speeds, currents and a gyro, without a pose."""
