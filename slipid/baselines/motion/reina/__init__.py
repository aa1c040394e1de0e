"""Reina and others' slip detectors: indicators from encoders, gyro and currents."""
