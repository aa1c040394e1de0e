"""Floor maps from pictures: the surface that each cell of a floor resembles."""
