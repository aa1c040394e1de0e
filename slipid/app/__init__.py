"""Configs, and the work of each command except its output."""
