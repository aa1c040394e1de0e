"""What runs on the robot: the deployed robot, estimators, controllers. Needs jax alone."""
