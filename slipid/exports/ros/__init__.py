"""The parts of a ROS 2 folder; `slipid.exports.ros.folder` puts them together."""
