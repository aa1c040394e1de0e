"""Which surface each cell of a floor looks like: colour, light, texture and neighbours."""
