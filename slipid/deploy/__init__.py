"""From a fit or a posterior to the robot's record, and to exported folders."""
