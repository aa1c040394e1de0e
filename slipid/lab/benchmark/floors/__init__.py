"""Floor classification from wheel speeds, currents and a gyro: slipid's and published methods."""
