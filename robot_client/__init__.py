"""The robot's side: the daemon that connects a robot to a relay, and programs beside it.

A message of a client passes ``link/`` (bytes to frames), ``channel/`` (frames to publications and calls), ``motion/``
where it may move the robot, and ``platforms/ros2/``, which hands it to DDS. ``run.py`` builds the daemon.
"""
