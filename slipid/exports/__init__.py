"""Deployable forms of a robot: C99, ROS 2, StableHLO, tables of parameters and gains."""
