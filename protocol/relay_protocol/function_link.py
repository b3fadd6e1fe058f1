"""Messages of a function link (SPEC 2.8): MessagePack in samples, whose number is that of the request."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from relay_protocol.limits import FUNCTION_BYTES, KIB, NAME

FUNCTION_FRAME = FUNCTION_BYTES + 16 * KIB
"""Largest frame of a function link, in both directions."""

MAX_WAIT = 60.0
"""Longest time for which the relay waits with the answer about a job, seconds."""

MAX_DEADLINE = 86_400.0
"""Longest deadline of a call, seconds."""

JobId = Annotated[str, Meta(max_length=32)]


class CallFunction(msgspec.Struct, frozen=True, kw_only=True, tag="call", tag_field="op"):
    """Robot: run a function.

    :param arguments: MessagePack of a map
    :param version: ``None`` for the newest
    :param deadline: seconds from now; ``None`` for the relay's default
    :param keep: answer with the job at once, and keep the result until it is fetched
    :param key: a repeated call with this key is carried out once; empty for none
    """

    function: Annotated[str, Meta(max_length=NAME)]
    arguments: bytes
    version: int | None = None
    deadline: Annotated[float, Meta(gt=0, le=MAX_DEADLINE)] | None = None
    keep: bool = False
    key: Annotated[str, Meta(max_length=NAME)] = ""


class CancelFunction(msgspec.Struct, frozen=True, kw_only=True, tag="cancel", tag_field="op"):
    """Robot: end a call, or remove a job that has ended."""

    job: JobId


class FetchResult(msgspec.Struct, frozen=True, kw_only=True, tag="fetch", tag_field="op"):
    """Robot: the state and result of a job that is kept.

    :param wait: seconds to wait for its end
    """

    job: JobId
    wait: Annotated[float, Meta(ge=0, le=MAX_WAIT)] = 0.0


FunctionRequest = CallFunction | CancelFunction | FetchResult


class FunctionReply(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Relay: the state of a call. For each call there may be several, the last is ``final``.

    :param final: whether it is the answer; otherwise the progress
    :param state: as in HTTP; ``refused`` for a request that was not carried out
    :param value: MessagePack of the result
    :param seconds: for which it ran
    """

    job: str = ""
    state: str
    final: bool = True
    code: str = ""
    error: str = ""
    value: bytes | None = None
    seconds: float = 0.0
    progress: float = 0.0
    text: str = ""


decode_request = msgspec.msgpack.Decoder(FunctionRequest).decode
decode_reply = msgspec.msgpack.Decoder(FunctionReply).decode
