"""The place of a camera above the floor, from a lying board or measured points."""
