"""Services of a robot: small ROS 2 nodes, each started by ``switchboard-robot-service NAME``.

What a service knows is in a module of plain functions and classes; the module with ``_node`` in its name puts that
into the graph. They need no relay and no daemon: to the relay their topics are topics of the robot.
"""
