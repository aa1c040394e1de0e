<<<<<<< ours
"""Published systems that predict motion or slip."""
=======
"""Slip from the encoders and the currents alone: no slip at all, corrections, and slip curves."""
>>>>>>> theirs
