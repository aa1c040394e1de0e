"""Published laws that steer a robot along a path, to drive beside the robot's own controllers."""
