"""Order, signs and axes that explain the motion."""
