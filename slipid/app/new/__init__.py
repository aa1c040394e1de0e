"""A config for a robot that nobody has described yet: asked for, or proposed from its logs."""
