"""Published systems that predict the body's motion or slip."""
