"""Published methods to compare with, one file per system."""
