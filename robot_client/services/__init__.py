"""Services of a robot: small ROS 2 nodes, each started by ``switchboard-robot-service NAME``.

Each service has a module of plain functions and classes, and a module with ``_node`` in its name that connects them to
the graph. Services need no relay and no daemon: to the relay their topics are topics of the robot.
"""
