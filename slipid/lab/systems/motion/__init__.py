"""Ward and Iagnemma's slip detector: an extended Kalman filter on a robot's dynamics."""
