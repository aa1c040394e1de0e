"""The parts of a ROS 2 folder; `slipid.export.ros.folder` puts them together."""
