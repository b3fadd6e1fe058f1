"""Clients that speak the Foxglove websocket protocol, such as the Foxglove app and Lichtblick.

The subprotocol of the handshake decides that a connection speaks it (:mod:`relay_server.ws.handshake`).
:class:`~relay_server.foxglove.port.FoxglovePort` is the port of such a client: it decodes ``messages`` and passes
them to the session as the same operations that rosbridge has. So rights, control, age, limits and quotas are those of
every client. Each group of operations has a file: ``topics``, ``publications``, ``services``, ``parameters``,
``connection_graph``, ``assets``, ``statuses``. ``advertisements`` is the base of ``topics`` and ``services``.
"""
