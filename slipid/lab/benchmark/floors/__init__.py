"""Telling the floor from wheels, currents and a gyro: slipid's floor filter beside classifiers."""
