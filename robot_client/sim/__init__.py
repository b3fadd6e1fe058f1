"""A simulated robot: a real ROS 2 node that drives a small world with walls, a scanner and a camera."""
