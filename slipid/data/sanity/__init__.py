"""Check of encoders, commands, gyro and poses against each other, before anything is fitted."""
