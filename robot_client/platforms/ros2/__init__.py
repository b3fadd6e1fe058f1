"""ROS 2 as a platform."""
