<<<<<<< ours
<<<<<<< ours
"""Bags of ROS messages: rosbag1, rosbag2 (sqlite3) and MCAP, read without a ROS install."""
=======
"""The files of a bag: what kind they are, whether they are whole, and what is in them."""
>>>>>>> theirs
=======
"""The files of a bag: what kind they are, whether they are whole, and what is in them."""
>>>>>>> theirs
