"""Plain values, as JSON and TOML files hold them."""

from typing import Any

Content = dict[str, Any]
"""Content of such a file, or of a table in it: numbers, words, lists and tables by name."""
