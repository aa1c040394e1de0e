"""Motors on a bench: constants with intervals, fitted to voltage, current and speed."""
