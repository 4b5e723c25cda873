"""ROS 2 bags: MCAP and SQLite, split and compressed, read with `rosbags`."""
