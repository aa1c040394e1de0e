"""Pictures of results, with one module per subject."""
