"""Every published system on the same logs: what `slipid benchmark` does."""
