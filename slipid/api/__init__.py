"""Public functions of `import slipid`: fit, check, simulate_runs, drive, export and track."""
