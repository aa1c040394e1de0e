"""The sanity check of runs before a fit: findings and their remedies."""
