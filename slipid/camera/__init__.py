"""Camera calibration, poses and floor maps from pictures: the only package that needs OpenCV."""
