"""Runs and floors as data: readers of log files, signals of runs, windows and floor maps."""
