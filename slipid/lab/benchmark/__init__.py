"""Implementation of `slipid benchmark`: slipid and every published system on the same logs."""
