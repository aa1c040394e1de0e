"""The clock of a camera against that of a robot, from what both saw of the motion."""
