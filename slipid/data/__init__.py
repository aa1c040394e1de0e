"""Recorded runs: readers, signals, windows, floor maps."""
