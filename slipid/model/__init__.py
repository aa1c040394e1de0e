"""Physics of one instant (geometry, motor, slip, contact) and its rollout over time."""
