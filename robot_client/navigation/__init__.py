"""A small navigator with the interface of Nav2, for robots without one.

The order to read in: grid, costmap, planner, pursuit, recovery, navigator (all pure), transforms, node (ROS).
"""
