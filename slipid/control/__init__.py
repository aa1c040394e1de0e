"""What runs on the robot: frozen estimator, controllers, closed loop. Needs jax alone."""
