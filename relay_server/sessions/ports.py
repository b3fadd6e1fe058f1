"""What a session works with: the websocket under it, the relay's own node, and its times."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from relay_protocol import limits

if TYPE_CHECKING:
    from relay_server.sessions.session import Session


class ClientTransport(Protocol):
    """The websocket under a session.

    :ivar vouches: whether an answer to a ping shows that who commands is still there
    """

    vouches: bool

    def send(self, frames: bytes) -> None:
        """One or more whole websocket frames, see :mod:`relay_server.common.websocket_frames`."""

    def ping(self, payload: bytes) -> None:
        """A websocket ping."""

    def close(self, code: int, reason: str) -> None:
        """Close with a code of :mod:`relay_server.common.close_codes`."""


class LocalNode(Protocol):
    """The relay's own services and topics in every robot's graph (``/relay/…``, ``/rosapi/…``)."""

    def service(self, name: str) -> Callable[[Session, Any], Awaitable[Any]] | None:
        """The handler of a service the relay itself offers."""

    def topic(self, name: str) -> Callable[[Session], dict[str, Any]] | None:
        """What makes the messages of a topic the relay itself publishes."""

    def pushed(self, name: str) -> bool:
        """Whether such a topic is published when it changes, and not once a second."""


class ActivityListener(Protocol):
    """Who takes notes of what clients do, beside all samples."""

    def __call__(self, kind: str, **data: Any) -> None:
        """Something has begun or ended: ``kind`` such as ``goal.begun``."""


def ignore_activity(kind: str, **data: Any) -> None:
    """Nobody takes notes."""


@dataclass(frozen=True)
class Timing:
    """Times of a session, seconds, and bytes of a message; see :class:`relay_server.config.RelaySettings`."""

    client_ping: float
    driving_ping: float
    stall_limit: float
    largest_message: int = limits.CLIENT_MESSAGE
