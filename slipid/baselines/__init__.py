"""Published methods to compare with, a folder per system."""
