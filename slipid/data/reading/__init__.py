"""Files of any layout to logs in SI units, checked at the door."""
