"""Conversion of a fit or a posterior to robot.json, and export of folders of files for a robot."""
