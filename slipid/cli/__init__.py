"""The command line of slipid, with a module for each command."""
