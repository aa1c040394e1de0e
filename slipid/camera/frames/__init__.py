"""Frames and their times, from a video, a folder of pictures or a plugged-in camera."""
