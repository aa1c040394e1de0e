"""A motor on a bench: its constants from voltage, current and speed, and how sure they are."""
