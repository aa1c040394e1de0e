"""Bags of ROS messages: rosbag1, rosbag2 (sqlite3) and MCAP, read without a ROS install."""
