"""A look into log files: what their columns hold, proposed as a config with open questions."""
