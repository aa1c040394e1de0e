"""Motion of wheels, commands, gyro and poses over the same steps."""
