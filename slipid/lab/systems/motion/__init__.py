"""Published systems that predict motion or slip."""
