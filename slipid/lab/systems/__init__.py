"""Published systems to compare with: equations, sources, and every liberty taken."""
