"""Speeds, stalls, lags and the order of wheels, from raw channels."""
