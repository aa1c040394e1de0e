"""Physics of one instant: geometry, motor, slip, contact."""
