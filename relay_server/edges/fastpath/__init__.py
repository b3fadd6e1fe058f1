"""The fast path: what most bytes are, whole text messages and pongs, without Autobahn's and Twisted's detours.

``receiving`` cuts the stream of a client into frames. Whole text messages and pongs go straight to whom they are for;
every other frame goes to Autobahn, which keeps the handshake, fragments, pings, closing, and all that breaks RFC 6455.
``sending`` puts what is written on the socket at once, and joins what follows within the same turn of the reactor.

Nothing here may change what a peer sees: the tests feed the same bytes to a plain Autobahn protocol.
"""

from relay_server.edges.fastpath.receiving import FastProtocol
from relay_server.edges.fastpath.sending import Turns, Writer, writer_for

__all__ = ["FastProtocol", "Turns", "Writer", "writer_for"]
