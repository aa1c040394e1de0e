"""Reference of the keys of a config, made from the docstrings and types of its models."""
