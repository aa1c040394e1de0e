<<<<<<< ours
<<<<<<< ours
"""Floor maps from pictures: which surface each cell of a floor looks like."""
=======
"""A map of the floor from one picture from above: which surface lies where, in metres."""
>>>>>>> theirs
=======
"""A map of the floor from one picture from above: which surface lies where, in metres."""
>>>>>>> theirs
