"""Clients that live in the relay: judged, counted and arbitrated like those that come by websocket."""

from relay_server.inside.client import Answer, InsideClient, MaybeDone
from relay_server.inside.guests import Guest, Guests

__all__ = ["Answer", "Guest", "Guests", "InsideClient", "MaybeDone"]
