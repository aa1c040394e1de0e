"""What any program needs and that knows nothing of robots: errors, files, executor, progress."""
