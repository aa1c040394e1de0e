"""The files of a bag: what kind they are, whether they are whole, and what is in them."""
