"""Floors by wheels, currents and a gyro: slipid's floor filter beside other classifiers."""
