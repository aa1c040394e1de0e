"""Fit of a robot model: likelihood of windows, its noise variances, and search for its maximum."""
