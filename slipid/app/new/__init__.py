"""Write a commented config for a new robot, from answers or from its log files."""
