"""Columns of a log file: what their names say, and which channels they hold."""
