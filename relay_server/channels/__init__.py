"""One channel for each robot in use: one uplink to the robot, many sessions on the other side."""
