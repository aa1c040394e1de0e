"""Which runs to drive next."""
