"""Coordinates in which a posterior is nearly a standard Gaussian, learnt from draws of it."""
