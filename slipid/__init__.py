"""Identify a wheeled robot's motors, load shares and wheel-floor contact from its own logs."""

from __future__ import annotations

__version__ = "0.1.0"
