"""The ROS 2 platform.

Beside it only the guard, ``services/``, ``devices/``, ``navigation/`` and ``sim/`` import rclpy.
"""
