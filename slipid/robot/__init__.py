"""Software that runs on the robot: deployed robot, estimators, controllers.

It needs only jax, equinox and numpy.
"""
