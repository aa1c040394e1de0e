"""Content of the files in a ROS 2 folder; `slipid.exports.ros.folder` combines them."""
