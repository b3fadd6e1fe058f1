"""Control of a robot: the right to move it, and stops (SPEC 1.7).

Requests enter at ``service``; ``gateway`` is for callers without a session. Commands do not pass here:
:class:`relay_server.sessions.publishing.PublishHandler` asks :meth:`RobotController.may_command` and
``acquire_by_command``.
"""
