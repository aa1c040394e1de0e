"""Do encoders, commands, gyro and poses tell of the same robot? Asked before anything is fitted."""
