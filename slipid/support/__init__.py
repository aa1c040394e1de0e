"""Support that knows nothing of robots: errors, files, checkpoints, executors, progress."""
