"""Text for people: tables of results, and the sentences around them."""
