"""One message from a robot, on its way to many clients: converted once for each form anybody wants."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from relay_protocol import jsontext, limits, rosbridge
from relay_protocol.errors import Invalid, SwitchboardError
from relay_protocol.ros_types import TypeRegistry
from relay_server.forms import Form, frames

if TYPE_CHECKING:
    from relay_server.channel.listener import Listener


class Sample:
    """One message from the robot. It is converted only if somebody takes it, and then once for all who want it so."""

    __slots__ = ("_body", "_convert", "_frames", "_json", "failure", "size")

    def __init__(self, body: bytes, convert: Callable[[bytes], bytes]) -> None:
        self._body = body
        self._convert = convert
        self.size = len(body)
        self._json: bytes | None = None
        self._frames: dict[tuple[str, Form], bytes] = {}
        self.failure: str = ""

    @property
    def body(self) -> bytes:
        """The message as the robot sent it."""
        return self._body

    def open(self, listener: Listener) -> bytes | None:
        """The websocket frames for a client that listens so; ``None`` when it can't be converted."""
        key = (listener.name, listener.form)
        found = self._frames.get(key)
        if found is None:
            if self._json is None:
                if self.failure:
                    return None
                try:
                    self._json = self._convert(self._body)
                except SwitchboardError as error:
                    self.failure = str(error)
                    return None
            found = self._frames[key] = frames(rosbridge.publish(listener.name, self._json), listener.form)
        return found


def converter(types: TypeRegistry, type_name: str, encoding: str) -> Callable[[bytes], bytes]:
    """What turns a sample's body into JSON."""
    if encoding == "json":
        return _json_anew
    return lambda body: types.to_json(type_name, body)


def _json_anew(body: bytes) -> bytes:
    """A robot's own JSON, decoded and written anew: what goes out is well-formed whatever came in."""
    if len(body) > limits.JSON_BODY:
        raise Invalid(f"JSON of {len(body)} bytes; a sample in JSON may have {limits.JSON_BODY}")
    return jsontext.encode(jsontext.decode_any(body))
