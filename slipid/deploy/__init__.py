"""Conversion of a fit or a posterior to the robot's record, and export of folders for a robot."""
