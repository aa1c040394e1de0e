"""The files of a ROS 2 folder; `slipid.exports.ros.folder` combines them."""
