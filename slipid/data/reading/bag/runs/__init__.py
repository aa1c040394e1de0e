"""Where the runs of a bag begin and end."""
