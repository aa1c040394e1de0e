"""Log files: how each is laid out, and which belong together."""
