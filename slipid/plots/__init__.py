"""Pictures of results, one file per subject."""
