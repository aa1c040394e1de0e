"""Physics of a robot in steady motion: geometry, motors, slip, contact forces, and the camera."""
