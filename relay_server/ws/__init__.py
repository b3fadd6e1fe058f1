"""Websockets of clients, built on Autobahn in three layers and a client on top.

1. :class:`~relay_server.ws.fast_receive.FastProtocol` reads text messages of one frame and pongs, and leaves the others
   to Autobahn.
2. :class:`~relay_server.ws.bounded.BoundedProtocol` bounds memory and time, and ends the connection in order.
3. :class:`~relay_server.ws.connection.ClientConnection` authenticates the client, and sets ``on_text`` to the
   ``message`` of a :class:`~relay_server.ws.handshake.WebSocketHandler`: for rosbridge this is
   :class:`relay_server.sessions.rosbridge_port.RosbridgePort`.
"""
