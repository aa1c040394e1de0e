"""From a fit to what runs on the robot: the only room that knows identify and control together."""
