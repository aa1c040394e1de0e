"""What robot.json holds, and how it is read, checked and written."""
