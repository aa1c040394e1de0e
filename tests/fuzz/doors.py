"""All doors of slipid."""

from __future__ import annotations

from tests.fuzz import config_doors, log_doors, result_doors, traps
from tests.fuzz.door import Door

DOORS = (*log_doors.DOORS, *config_doors.DOORS, *result_doors.DOORS)


def door_of(name: str) -> Door:
    """Return the door, or the trap, of a name."""
    return next(door for door in (*DOORS, *traps.TRAPS, traps.ENDLESS) if door.name == name)
