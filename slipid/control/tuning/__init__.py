"""Gains by rehearsal on the identified robot; not deployed."""
