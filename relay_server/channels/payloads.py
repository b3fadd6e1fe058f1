"""Bodies of services and actions: as the robot speaks them (CDR, else JSON), and as JSON for clients."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
from twisted.internet.defer import Deferred

from relay_protocol import json_cost, jsontext, limits, link, nonfinite
from relay_protocol.errors import Invalid
from relay_server.channels.definitions import Definitions
from relay_server.channels.robot_link import RobotLinkState

LARGEST = limits.COMMAND_FRAME // 4 * 3 - 4096
"""Bytes of CDR that still fit a frame to a robot in base64, beside the names."""

Text = msgspec.Raw | msgspec.UnsetType


class PayloadCodec:
    """Turns bodies from one form into another. A part of a type is named like ``std_srvs/srv/Trigger_Request``.

    :param now_ns: the robot's time, nanoseconds, for header stamps a client leaves out
    """

    def __init__(self, wire: RobotLinkState, definitions: Definitions, now_ns: Callable[[], int]) -> None:
        self._wire = wire
        self._definitions = definitions
        self._now_ns = now_ns

    def ready(self, type_name: str) -> Deferred[None]:
        """Fires when the parts of this type can be turned; fails in words when they never can."""
        return self._definitions.ready(type_name)

    def from_client(self, part: str, text: bytes) -> bytes:
        """A body out of a client's JSON; fields it leaves out get their defaults.

        :param text: an object, or a list of the fields in order; nothing and ``null`` are an empty object
        :raises Invalid: it does not fit the type, or is too large for a robot
        :raises NotFound: the type's definition is not known
        """
        types = self._wire.robot.types
        json_cost.check(text)
        if not text.startswith(b"{"):
            # The fields in order, or nothing: these are looked at one by one.
            json_cost.check_odd(text)
        if self._wire.cdr or types.knows(part):
            body = types.args_from_json(part, text, self._now_ns())
        if not self._wire.cdr:
            body = self._as_json(part, text, jsontext.decode_any(text) if text else {})
        if len(body) > LARGEST:
            raise Invalid(f"{part} has {len(body)} bytes here; a robot takes at most {LARGEST}")
        return body

    def _as_json(self, part: str, text: bytes, value: Any) -> bytes:
        """What a client said, for a robot that speaks JSON: in its own words, so that numbers keep all their digits."""
        if value is None or not text:
            return b"{}"
        if not isinstance(value, dict | list):
            raise Invalid(f"{part} must be an object, or a list of its fields in order")
        if isinstance(value, list) and self._wire.robot.types.knows(part):
            fields = self._wire.robot.types.definitions(part)[part].fields
            values = msgspec.json.decode(text, type=list[msgspec.Raw])
            text = jsontext.encode({field.name: each for field, each in zip(fields, values, strict=False)})
        return nonfinite.as_null(text)

    def to_client(self, part: str, body: bytes) -> bytes:
        """A body as JSON.

        :raises Invalid: the bytes are no such body
        :raises NotFound: the type's definition is not known
        """
        if self._wire.cdr:
            return self._wire.robot.types.to_json(part, body)
        return body if jsontext.decode_any(body) is not None else b"{}"

    def from_robot(self, part: str, cdr: str | None, text: Text) -> bytes:
        """A body out of a message of the robot, from its ``cdr`` or its ``args`` or ``values``.

        :raises Invalid: it is none
        """
        if cdr is None and self._wire.cdr:
            return self.from_client(part, bytes(text or b""))
        if cdr is None:
            return self.to_client(part, bytes(text or b"{}"))
        if not self._wire.cdr:
            raise Invalid("the robot announced JSON and sent CDR")
        return link.from_base64(cdr, "cdr")

    def args(self, body: bytes) -> dict[str, Any]:
        """A body as fields of a call or a goal for the robot."""
        return self._fields("args", body)

    def values(self, body: bytes) -> dict[str, Any]:
        """A body as fields of an answer for the robot."""
        return self._fields("values", body)

    def _fields(self, name: str, body: bytes) -> dict[str, Any]:
        return {"cdr": link.to_base64(body)} if self._wire.cdr else {name: msgspec.Raw(body)}
