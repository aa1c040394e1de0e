"""Command line, configuration, progress and plots: the only room that imports all others."""
