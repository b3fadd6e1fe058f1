"""The interfaces between a session and its client.

The port of a session is its client's side: it decodes what the client sends into operations for
:meth:`relay_server.sessions.session.Session.perform`, and takes the answers. A port for websockets
(:class:`relay_server.sessions.websocket_port.WebsocketPort`) writes to a :class:`ClientTransport`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from relay_protocol import limits, rosbridge
from relay_server.channels.client_subscription import ClientSubscription
from relay_server.channels.offered_services import ProviderPort
from relay_server.channels.samples import Sample
from relay_server.common.unfinished import UnfinishedCount


class ClientPort(ProviderPort, Protocol):
    """Takes a session's answers.

    A :class:`~relay_server.sessions.rosbridge_port.RosbridgePort` and a
    :class:`~relay_server.foxglove.port.FoxglovePort` encode them for a websocket; an
    :class:`~relay_server.in_process_sessions.in_process_port.InProcessPort` uses the values.

    Values of services, goals and samples are JSON of the message alone.
    """

    @property
    def proves_liveness(self) -> bool:
        """Whether an answer to a ping shows that the client is still there."""

    @property
    def dropped_samples(self) -> int:
        """Samples dropped because the client did not read in time."""

    @property
    def drops_by_topic(self) -> Mapping[str, int]:
        """Dropped samples by topic, of the topics that are subscribed now."""

    @property
    def waiting_bytes(self) -> int:
        """Bytes that wait for the client."""

    @property
    def rate(self) -> float | None:
        """Bytes per second that the connection carries, where it has proved to be slow; else ``None``."""

    def deliver(self, subscription: ClientSubscription, sample: Sample) -> None:
        """Send or queue a sample; older ones may be dropped for it."""

    def dropped(self, subscription: ClientSubscription) -> None:
        """Count a sample that was evicted before it was delivered."""

    def forget(self, key: ClientSubscription | object) -> None:
        """Drop queued samples of a subscription, or feedback of a goal."""

    def status(self, level: str, text: str, id: rosbridge.Id = None) -> None:
        """Send a status, if the client has requested that level."""

    def warn_of_drops(self, text: str, id: rosbridge.Id = None) -> None:
        """Warn of samples or messages that the robot's link is too slow for; of each topic this is called rarely."""

    def service_response(self, call: rosbridge.CallService, result: bool, values: bytes) -> None:
        """Answer a call.

        :param values: JSON; a string with the reason when ``result`` is false
        """

    def action_feedback(self, key: object, goal: rosbridge.SendActionGoal, values: bytes) -> None:
        """Send feedback of a goal; newer feedback replaces older that waits under the same key."""

    def action_result(self, goal: rosbridge.SendActionGoal, status: int, result: bool, values: bytes) -> None:
        """End a goal.

        :param status: of ``action_msgs/msg/GoalStatus``; 0 for a goal that never began
        :param values: JSON; a string with the reason when ``result`` is false
        """

    def ping(self) -> None:
        """Ping the client now: messages that come after its pong were sent after this."""

    def rights_changed(self) -> None:
        """The client's rights have changed."""

    def disconnect(self, code: int, reason: str) -> None:
        """Close the connection with a code of :mod:`relay_server.common.close_codes`."""

    def ended(self) -> None:
        """The session is over; nothing more is sent."""


class ClientTransport(Protocol):
    """The websocket of a session: a :class:`~relay_server.ws.connection.ClientConnection`."""

    @property
    def unfinished(self) -> UnfinishedCount | None:
        """Counts bytes of unfinished messages of the user; set before the session begins."""

    def send(self, frames: bytes) -> None:
        """Send one or more whole websocket frames, see :mod:`relay_server.common.websocket_frames`."""

    def ping(self, payload: bytes) -> None:
        """Send a websocket ping."""

    def close(self, code: int, reason: str, farewell: bytes | None = None) -> None:
        """Close with a code of :mod:`relay_server.common.close_codes`.

        :param farewell: frames of a message with the reason, sent before the close frame; ``None``: that of the
            client's dialect, if it has one
        """


class ActivityListener(Protocol):
    """Called with activities of a client, which become events; samples are none."""

    def __call__(self, kind: str, **data: Any) -> None:
        """An activity has begun or ended.

        :param kind: of the event, such as ``goal.begun``
        """


def ignore_activity(kind: str, **data: Any) -> None:
    """An :class:`ActivityListener` that does nothing."""


@dataclass(frozen=True)
class Timing:
    """Times of a session, seconds, and bytes of a message; see :class:`relay_server.config.RelaySettings`."""

    client_ping: float
    driving_ping: float
    stall_limit: float
    largest_message: int = limits.CLIENT_MESSAGE
