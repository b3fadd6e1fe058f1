"""rosbridge v2 operations a client may send, as one tagged union (SPEC section 1).

Message bodies stay undecoded (:class:`msgspec.Raw`): the relay decodes only what it judges, and the body
once, when its type is known.
"""

from __future__ import annotations

from typing import Any

import msgspec

from relay_protocol import jsontext
from relay_protocol.link import Message, QoS

Id = str | int | None
"""rosbridge says a string; some clients number their calls."""

Bodies = list[msgspec.Raw] | dict[str, msgspec.Raw]


class Advertise(Message, frozen=True, kw_only=True):
    topic: str
    type: str
    id: Id = None
    latch: bool = False
    queue_size: int = 100
    qos: QoS | None = None


class Unadvertise(Message, frozen=True, kw_only=True):
    topic: str
    id: Id = None


class Publish(Message, frozen=True, kw_only=True):
    topic: str
    msg: msgspec.Raw = msgspec.Raw(b"{}")
    id: Id = None
    latch: bool = False
    queue_size: int = 100
    qos: QoS | None = None
    type: str = ""


class Subscribe(Message, frozen=True, kw_only=True):
    topic: str
    id: Id = None
    type: str | None = None
    throttle_rate: float = 0
    queue_length: int = 0
    fragment_size: int | None = None
    compression: str = "none"
    qos: QoS | None = None


class Unsubscribe(Message, frozen=True, kw_only=True):
    topic: str
    id: Id = None


class CallService(Message, frozen=True, kw_only=True):
    service: str
    id: Id = None
    args: msgspec.Raw | msgspec.UnsetType = msgspec.UNSET
    type: str = ""
    fragment_size: int | None = None
    compression: str = "none"
    timeout: float | None = None


class ServiceResponse(Message, frozen=True, kw_only=True):
    service: str
    result: bool = True
    id: Id = None
    values: msgspec.Raw | msgspec.UnsetType = msgspec.UNSET


class AdvertiseService(Message, frozen=True, kw_only=True):
    service: str
    type: str
    id: Id = None


class UnadvertiseService(Message, frozen=True, kw_only=True):
    service: str
    id: Id = None


class SetLevel(Message, frozen=True, kw_only=True, tag="set_level"):
    level: str
    id: Id = None


class Auth(Message, frozen=True, kw_only=True):
    """rosauth's message; ``mac`` carries the access token, the rest is taken and not used."""

    mac: str
    client: Any = None
    dest: Any = None
    rand: Any = None
    t: Any = None
    level: Any = None
    end: Any = None
    id: Id = None


ClientOp = (
    Advertise
    | Unadvertise
    | Publish
    | Subscribe
    | Unsubscribe
    | CallService
    | ServiceResponse
    | AdvertiseService
    | UnadvertiseService
    | SetLevel
    | Auth
)

_decoder: msgspec.json.Decoder[ClientOp] = msgspec.json.Decoder(ClientOp)


def decode(data: bytes) -> ClientOp:
    """One client message.

    :raises MalformedMessage: not strict JSON, an unknown ``op``, a field missing or of the wrong type
    """
    return jsontext.decode(_decoder, data)


def publish(topic: str, body: bytes) -> bytes:
    """A ``publish`` towards a client, around a body that is JSON already."""
    return b'{"op":"publish","topic":' + jsontext.encode(topic) + b',"msg":' + body + b"}"


def service_response(service: str, id: Id, result: bool, values: bytes) -> bytes:
    """A ``service_response`` towards a client; ``values`` is JSON, a string when ``result`` is false."""
    head = b'{"op":"service_response","service":' + jsontext.encode(service)
    if id is not None:
        head += b',"id":' + jsontext.encode(id)
    return head + b',"result":' + (b"true" if result else b"false") + b',"values":' + values + b"}"


def status(level: str, text: str, id: Id = None) -> bytes:
    """A ``status`` towards a client, for those who asked with ``set_level``."""
    message: dict[str, Any] = {"op": "status", "level": level, "msg": text}
    if id is not None:
        message["id"] = id
    return jsontext.encode(message)
