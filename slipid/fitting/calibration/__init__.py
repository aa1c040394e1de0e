"""Calibration of the kinematics and the pose sensor from poses, with which every fit begins."""
