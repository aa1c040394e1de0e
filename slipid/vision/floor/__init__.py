"""A map of the floor from one picture from above: which surface lies where, in metres."""
