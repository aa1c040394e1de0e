"""Floor maps by the names of their surfaces."""

import numpy as np

from slipid.data.floor_map import FloorMap


def surface_at(floor: FloorMap, x: float, y: float) -> str:
    """Name of the surface at a place [m]."""
    return floor.surfaces[int(floor.at(np.array([x, y])))]
