"""Pictures of results, a file per subject."""
