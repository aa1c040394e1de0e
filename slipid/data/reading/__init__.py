"""Reading of files of any layout as logs in SI units, with all checks."""
