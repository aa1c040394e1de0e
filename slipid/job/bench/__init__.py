"""Motors on a bench: from their logs to numbers, and from these to the priors of a robot."""
