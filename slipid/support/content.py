"""Type of the plain values in JSON and TOML files."""

from typing import Any

Content = dict[str, Any]
"""Content of a JSON or TOML file, or of a table in it: numbers, strings, lists and tables keyed by
name."""
