"""Made logs with known truth, and what a fit makes of them."""
