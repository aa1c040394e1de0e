<<<<<<< ours
<<<<<<< ours
"""The sanity check of runs before a fit: findings and their remedies."""
=======
"""Check of encoders, commands, gyro and poses against each other, before anything is fitted."""
>>>>>>> theirs
=======
"""Order, signs and axes that explain the motion."""
>>>>>>> theirs
