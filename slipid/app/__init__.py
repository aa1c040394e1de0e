"""Configs, and the work behind each command."""
