"""Camera calibration, poses and floor maps from images: the only package that needs OpenCV."""
