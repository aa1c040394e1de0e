"""Closed-loop trials of controllers, published laws among them."""
