"""Poses of bodies with markers from the video of an overhead camera."""
