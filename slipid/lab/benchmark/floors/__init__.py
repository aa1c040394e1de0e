"""Floor classification from wheel speeds, currents and a gyro: slipid's filter and others."""
