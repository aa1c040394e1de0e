"""A run beside its predictions, and its file for viewers."""
