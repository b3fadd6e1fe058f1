"""The robots' side of the relay: links, registry, mirror of the ROS graph, link quality.

:class:`~relay_server.robots.connection.RobotConnection` frames and paces the bytes of one link. Its handler
(``link_handlers``) passes messages on: those of a control link to the registry and to the controller, those of a
channel link to the robot's :class:`~relay_server.channels.channel.Channel`.
"""
