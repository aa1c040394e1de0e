"""Results as text for people: tables, and the sentences around them."""
