"""From the video of an overhead camera to poses of what carries a marker."""
