"""What a config may say, from the docstrings and types that check it: one source for all help."""
