"""Motors on a bench: constants with intervals from voltage, current and speed."""
