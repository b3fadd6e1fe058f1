"""Several relays that serve one fleet: how they find each other, and which of them each robot is connected to.

:mod:`~relay_server.cluster.bus` carries short messages between relays and keeps their leases. A single relay has a
:class:`~relay_server.cluster.bus.LocalBus`; several have a :class:`~relay_server.cluster.nats_bus.NatsBus`.
"""
