<<<<<<< ours
<<<<<<< ours
"""Published systems that predict motion or slip."""
=======
"""Slip from the encoders and the currents alone: no slip at all, corrections, and slip curves."""
>>>>>>> theirs
=======
"""Ward and Iagnemma's slip detector: an extended Kalman filter on a robot's dynamics."""
>>>>>>> theirs
