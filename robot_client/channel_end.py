"""A channel on its connection."""

from __future__ import annotations

from collections.abc import Callable

from relay_protocol import link
from relay_protocol.errors import SwitchboardError
from robot_client.channel import Channel
from robot_client.link import Commanded, Ended, Event, JoinedChannel, Said, Sampled
from robot_client.transport import LinkLost, LinkProtocol
from robot_client.wire import Wire


class ChannelEnd(Wire):
    """Joins a channel to its connection."""

    def __init__(self, name: str, protocol: LinkProtocol, on_gone: Callable[[ChannelEnd, str], None]) -> None:
        self.name = name
        self.protocol = protocol
        self.channel: Channel
        self._on_gone = on_gone

    def say(self, message: link.Message) -> None:
        """Send a message."""
        self.protocol.link.say(message)
        self.protocol.flush()

    @property
    def room(self) -> int:
        """Bytes of sample frames that should be written now."""
        return self.protocol.room

    def write(self, frames: list[bytes]) -> None:
        """Send sample frames."""
        self.protocol.write(frames)

    def on_event(self, event: Event) -> None:
        """The relay said something."""
        if isinstance(event, Sampled):
            self.channel.sample(event.frame)
        elif isinstance(event, Commanded):
            self.channel.command(event.frame)
        elif isinstance(event, Said):
            self.channel.handle(event.message)
        elif isinstance(event, JoinedChannel) and event.channel != self.name:
            self.protocol.end(LinkLost(f"the relay joined us to '{event.channel}' instead of '{self.name}'"))
        elif isinstance(event, Ended):
            self.protocol.end(LinkLost(f"the relay closed the channel: {event.reason}"), gently=True)

    def on_lost(self, reason: SwitchboardError) -> None:
        """The connection is gone."""
        self._on_gone(self, str(reason))

    def on_pause(self) -> None:
        """The transport is full."""
        self.channel.pause()

    def on_resume(self) -> None:
        """The transport has room."""
        self.channel.resume()
