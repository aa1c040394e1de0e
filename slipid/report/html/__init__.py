"""The page that shows the results of a command: one file without network."""
