"""What the relay itself offers in every robot's graph: ``/rosapi/…`` and ``/relay/…``.

So any unmodified rosbridge client can use all of it, and no private operation is needed.
"""

from relay_server.local.node import RelayNode

__all__ = ["RelayNode"]
