"""Coordinates in which a posterior is nearly a standard Gaussian.

Nothing is known of a coordinate beforehand. Where data say no more than that a number is small, its
logarithm may be anything; a map whose other coordinates followed that number itself was steep where
it is large (curvatures of 60 to 250 on green carpet, 20 as it is, 1 would be ideal), and walkers
stood still there.
"""
