"""Records of other programs as logs: ROS bags, CSV files of any columns, and a known data set."""
