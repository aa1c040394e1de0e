"""A picture a file."""
