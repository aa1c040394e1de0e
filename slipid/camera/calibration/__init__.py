"""The lens of a camera, from views of a board."""
