"""General support, independent of robots: errors, files, checkpoints, executors and progress."""
