"""The messages of the Foxglove websocket protocol: JSON objects with an ``op``, and binary messages with an opcode.

All integers of binary messages are little endian. Source: ws-protocol ``docs/spec.md`` of Foxglove. Nothing here keeps
state.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Annotated, Any, NamedTuple

import msgspec

from relay_protocol import json_cost, nonfinite
from relay_protocol.errors import MalformedMessage
from relay_server.common import websocket_frames

SDK, LEGACY = "foxglove.sdk.v1", "foxglove.websocket.v1"
SUBPROTOCOLS = (SDK, LEGACY)
"""Names of the dialect, the preferred first. On the wire both are the same."""

INFO, WARNING, ERROR = 0, 1, 2
"""Levels of a ``status``."""

CLOSED = "closed"
"""Id of the status with the reason for which the connection is closed."""

LONGEST_NAME = 4096
"""Most characters of a name, a type, an encoding or an id in a message of a client."""

U32 = Annotated[int, msgspec.Meta(ge=0, lt=2**32)]
U53 = Annotated[int, msgspec.Meta(ge=0, le=2**53)]
Text = Annotated[str, msgspec.Meta(max_length=LONGEST_NAME)]


class _Struct(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """Base of what a client sends. Unknown fields are ignored, as later versions may have more."""


class SubscriptionEntry(_Struct, frozen=True, kw_only=True):
    """One subscription of ``subscribe``.

    :param id: chosen by the client; samples carry it
    """

    id: U32
    channel_id: U53


class ClientChannelEntry(_Struct, frozen=True, kw_only=True):
    """One channel of the client's ``advertise``. Its schema is not used: the robot's definition of the type counts."""

    id: U32
    topic: Text
    encoding: Text
    schema_name: Text


class ParameterEntry(_Struct, frozen=True, kw_only=True):
    """One parameter of ``setParameters``; without a value it is unset."""

    name: Text
    value: msgspec.Raw | msgspec.UnsetType = msgspec.UNSET
    type: Text | None = None


class SubscribeOp(_Struct, frozen=True, kw_only=True, tag_field="op", tag="subscribe"):
    subscriptions: list[SubscriptionEntry]


class UnsubscribeOp(_Struct, frozen=True, kw_only=True, tag_field="op", tag="unsubscribe"):
    subscription_ids: list[U32]


class AdvertiseOp(_Struct, frozen=True, kw_only=True, tag_field="op", tag="advertise"):
    channels: list[ClientChannelEntry]


class UnadvertiseOp(_Struct, frozen=True, kw_only=True, tag_field="op", tag="unadvertise"):
    channel_ids: list[U32]


class GetParametersOp(_Struct, frozen=True, kw_only=True, tag_field="op", tag="getParameters"):
    parameter_names: list[Text]
    id: Text | None = None


class SetParametersOp(_Struct, frozen=True, kw_only=True, tag_field="op", tag="setParameters"):
    parameters: list[ParameterEntry]
    id: Text | None = None


class SubscribeParametersOp(
    _Struct, frozen=True, kw_only=True, tag_field="op", tag="subscribeParameterUpdates"
):
    parameter_names: list[Text]


class UnsubscribeParametersOp(
    _Struct, frozen=True, kw_only=True, tag_field="op", tag="unsubscribeParameterUpdates"
):
    parameter_names: list[Text]


class SubscribeGraphOp(_Struct, frozen=True, kw_only=True, tag_field="op", tag="subscribeConnectionGraph"):
    pass


class UnsubscribeGraphOp(
    _Struct, frozen=True, kw_only=True, tag_field="op", tag="unsubscribeConnectionGraph"
):
    pass


class FetchAssetOp(_Struct, frozen=True, kw_only=True, tag_field="op", tag="fetchAsset"):
    uri: Text
    request_id: U32


ClientOp = (
    SubscribeOp
    | UnsubscribeOp
    | AdvertiseOp
    | UnadvertiseOp
    | GetParametersOp
    | SetParametersOp
    | SubscribeParametersOp
    | UnsubscribeParametersOp
    | SubscribeGraphOp
    | UnsubscribeGraphOp
    | FetchAssetOp
)

_decoder: msgspec.json.Decoder[ClientOp] = msgspec.json.Decoder(ClientOp)


def decode_text(data: bytes) -> ClientOp:
    """One text message of a client. NaN and infinity in values of parameters are marked, see
    :mod:`relay_protocol.nonfinite`.

    :raises MalformedMessage: not strict JSON, an unknown ``op``, a field missing or of the wrong type
    :raises NotFinite: NaN or infinity elsewhere
    :raises TooCostly: see :func:`relay_protocol.json_cost.check`
    """
    json_cost.check(data)
    return nonfinite.decode(_decoder, data, ("parameters",))


# --- binary messages of a client --------------------------------------------------------------------------

_U32 = struct.Struct("<I")
_CALL = struct.Struct("<III")
_MESSAGE, _SERVICE_CALL = 1, 2


class ClientMessage(NamedTuple):
    """A message that the client publishes.

    :param channel: the client's own number of the channel
    """

    channel: int
    payload: bytes


class ServiceCallMessage(NamedTuple):
    """A service call.

    :param call: the client's number of the call; the answer carries it
    """

    service: int
    call: int
    encoding: str
    payload: bytes


def decode_binary(data: bytes) -> ClientMessage | ServiceCallMessage:
    """One binary message of a client.

    :raises MalformedMessage: an unknown opcode, or it is too short
    """
    if not data:
        raise MalformedMessage("a binary message is empty; it must begin with an opcode")
    opcode = data[0]
    if opcode == _MESSAGE:
        if len(data) < 5:
            raise MalformedMessage(f"a message to publish has {len(data)} bytes; opcode and channel take 5")
        return ClientMessage(_U32.unpack_from(data, 1)[0], data[5:])
    if opcode == _SERVICE_CALL:
        if len(data) < 13:
            raise MalformedMessage(f"a service call has {len(data)} bytes; its head takes 13")
        service, call, length = _CALL.unpack_from(data, 1)
        if length > len(data) - 13:
            raise MalformedMessage(f"a service call ends within its encoding of {length} bytes")
        if length > LONGEST_NAME:
            raise MalformedMessage(f"the encoding of a service call has {length} bytes")
        encoding = data[13 : 13 + length].decode("utf-8", "replace")
        return ServiceCallMessage(service, call, encoding, data[13 + length :])
    raise MalformedMessage(f"binary messages with opcode {opcode} are not taken by this relay")


# --- messages to a client, as websocket frames ------------------------------------------------------------

_SAMPLE_HEAD = struct.Struct("<BIQ")
_RESPONSE_HEAD = struct.Struct("<BIII")
_TIME = struct.Struct("<BQ")
_ASSET_HEAD = struct.Struct("<BIBI")


def sample(subscription: int, time_ns: int, body: bytes) -> bytes:
    """The frame of one message of a channel.

    :param time_ns: nanoseconds at which the robot received it
    """
    return websocket_frames.binary_of(_SAMPLE_HEAD.pack(1, subscription, time_ns), body)


def time(time_ns: int) -> bytes:
    """The frame of the robot's time, nanoseconds."""
    return websocket_frames.binary(_TIME.pack(2, time_ns))


def call_head(service: int) -> bytes:
    """The first bytes of a client's call of a service."""
    return bytes([_SERVICE_CALL]) + _U32.pack(service)


def service_response(service: int, call: int, encoding: str, body: bytes) -> bytes:
    """The frame of the answer to a service call."""
    name = encoding.encode()
    return websocket_frames.binary_of(_RESPONSE_HEAD.pack(3, service, call, len(name)) + name, body)


def asset(request: int, body: bytes) -> bytes:
    """The frame of an asset."""
    return websocket_frames.binary_of(_ASSET_HEAD.pack(4, request, 0, 0), body)


def asset_failure(request: int, reason: str) -> bytes:
    """The frame that refuses an asset."""
    words = reason.encode()
    return websocket_frames.binary_of(_ASSET_HEAD.pack(4, request, 1, len(words)), words)


def text(op: str, **fields: Any) -> bytes:
    """The frame of a JSON message; names of fields as on the wire."""
    return websocket_frames.text(msgspec.json.encode({"op": op, **fields}))


def status(level: int, message: str, id: str | None = None) -> bytes:
    """The frame of a ``status``.

    :param id: replaces the status with the same id, and names it in :func:`remove_status`
    """
    fields = {} if id is None else {"id": id}
    return text("status", level=level, message=message, **fields)


def closing(reason: str) -> bytes:
    """The frame before a close frame. The apps show a status, and neither code nor reason of a close frame."""
    return status(ERROR, reason, CLOSED)


def remove_status(ids: Iterable[str]) -> bytes:
    """The frame that takes statuses back."""
    return text("removeStatus", statusIds=list(ids))
