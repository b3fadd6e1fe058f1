"""One session for each client of a robot: every message is judged and dispatched to a handler.

``manager`` opens sessions. A client's port (``rosbridge_port``, :mod:`relay_server.foxglove.port`, or
:mod:`relay_server.in_process_sessions.in_process_port`) decodes its messages and encodes its answers.
:class:`~relay_server.sessions.session.Session` dispatches operations to the handlers ``publishing``,
``subscriptions``, ``service_calls``, ``goals`` and ``offered_services``; rosbridge's ``publish``, nearly all that
clients send, goes from its port straight to ``publishing``. They use the robot's channel
(:mod:`relay_server.channels`), which knows the client by its :class:`~relay_server.sessions.context.ClientContext`.
"""
