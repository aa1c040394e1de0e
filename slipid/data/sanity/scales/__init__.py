"""Units and sizes that explain how far the robot went by each channel."""
