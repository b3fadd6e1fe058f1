"""Messages in CBOR (RFC 8949), as rosbridge's ``cbor`` and ``cbor-raw`` (SPEC section 1.6)."""

from __future__ import annotations

import cbor2
import orjson

from relay_protocol.limits import KIB

MOST = 256 * KIB
"""Largest JSON that is made CBOR, bytes. It takes 65 to 200 ms a megabyte, in which the relay does nothing else."""

_PUBLISH = b"\xa3" + b"".join(map(cbor2.dumps, ("op", "publish", "topic")))
"""The head of a map of three, its first pair, and the key of the second."""
_MSG = cbor2.dumps("msg")


def publish(topic: str, body: bytes) -> bytes:
    """A ``publish`` towards a client, around a body that is CBOR already."""
    return b"".join((_PUBLISH, cbor2.dumps(topic), _MSG, body))


def raw(stamp: int, body: bytes) -> bytes:
    """The ``msg`` of ``cbor-raw``: a sample as the robot sent it (rosbridge v2 protocol, section 3.1.4).

    :param stamp: the robot's time when it came, nanoseconds: since 1970, or since the simulation began
    :param body: CDR with its header
    """
    seconds, nanoseconds = divmod(stamp, 10**9)
    return cbor2.dumps({"secs": seconds, "nsecs": nanoseconds, "bytes": body})


def from_json(text: bytes) -> bytes:
    """JSON of our own in CBOR. It says what the JSON says: no typed arrays, ``null`` for NaN."""
    return cbor2.dumps(orjson.loads(text))
