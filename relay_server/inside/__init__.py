"""Clients that live in the relay: judged, counted and arbitrated like those that come by websocket."""

from relay_server.inside.client import Answer, InsideClient, MaybeDone
from relay_server.inside.guests import LINGER_SECONDS, Guest, Guests
from relay_server.inside.holding import Wishes, take_control

__all__ = [
    "LINGER_SECONDS",
    "Answer",
    "Guest",
    "Guests",
    "InsideClient",
    "MaybeDone",
    "Wishes",
    "take_control",
]
