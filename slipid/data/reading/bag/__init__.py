"""Reading of ROS bags (rosbag1, rosbag2 with sqlite3, MCAP) without an installation of ROS."""
