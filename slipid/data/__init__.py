"""Logs: readers, units, signals and the batched dataset."""
