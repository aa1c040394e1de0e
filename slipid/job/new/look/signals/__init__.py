"""What the numbers themselves tell: units by magnitudes, rates, signs, sums."""
