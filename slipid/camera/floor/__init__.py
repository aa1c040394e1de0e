"""Floor maps from pictures: which surface each cell of a floor looks like."""
