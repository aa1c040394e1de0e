"""Configs, and what each command does."""
