"""Runs: readers of logs, signals, windows and floor maps."""
