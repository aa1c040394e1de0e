"""The parts of a ROS 2 folder; `slipid.control.export.ros2` puts them together."""
