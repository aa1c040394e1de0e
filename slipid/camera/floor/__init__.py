"""Floor maps from images: the surface that each cell of a floor most resembles."""
