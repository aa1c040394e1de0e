"""Reading of log files of any layout: the result is checked logs in SI units."""
