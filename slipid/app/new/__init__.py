"""Proposal of a commented config for a new robot, from a user's answers or from log files."""
