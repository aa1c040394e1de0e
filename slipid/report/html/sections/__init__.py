"""Sections of the page of a fit; each returns None if the results have nothing for it."""
