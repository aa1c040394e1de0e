"""Logs of the virtual test site: config, runs, files."""
