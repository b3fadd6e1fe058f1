"""The reason and the id of a stop, as clients send them, for all entries: websocket, HTTP, admin socket, fleet orders.

An unusable one counts as none, so that no stop is refused for it.
"""

from __future__ import annotations

from typing import Any

import msgspec

from relay_protocol import jsontext, nonfinite
from relay_protocol.errors import SwitchboardError
from relay_protocol.limits import REASON_LENGTH, STOP_ID_LENGTH


def reason_of(value: Any) -> str:
    """The reason, cut to :data:`relay_protocol.limits.REASON_LENGTH`.

    :param value: as received
    """
    return value[:REASON_LENGTH] if isinstance(value, str) else ""


def reason_in(json: msgspec.Raw) -> str:
    """As :func:`reason_of`, for a reason in JSON; malformed JSON counts as none."""
    return reason_of(_decoded(json))


def stop_id_of(value: Any) -> str:
    """The id that a client gave a stop.

    :param value: as received
    """
    return value if isinstance(value, str) and len(value) <= STOP_ID_LENGTH else ""


def stop_id_in(json: msgspec.Raw) -> str:
    """As :func:`stop_id_of`, for an id in JSON; malformed JSON counts as none."""
    return stop_id_of(_decoded(json))


def _decoded(json: msgspec.Raw) -> Any:
    try:
        # NaN is no text.
        return nonfinite.to_floats(jsontext.decode_any(bytes(json)))
    except SwitchboardError:
        return None
