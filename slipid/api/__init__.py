"""Public functions of `import slipid`: fit, check, simulate, drive, export and track."""
