"""Slip models side by side on runs that none of them has seen."""
