"""Published systems to compare with, each with its equations, its source and every liberty taken."""
