"""Coordinates in which a posterior is nearly a standard Gaussian.

Bends and plateaus earn their keep: of the motion part of the 2022 logs (99 coordinates, 12 of them
plateaus) the geometric mean of effective draws per second is half without bends and two thirds
without plateaus; that of the slowest coordinate is less than half without either.
"""
