"""Text for people: tables of results, with sentences that explain them."""
