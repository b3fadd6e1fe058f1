"""Options in the URL of a Foxglove client, for thin links: ``?throttle=``, ``?stride=`` and ``?voxel=``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from relay_protocol import limits, link
from relay_protocol.errors import Invalid
from relay_server.channels.client_subscription import THROTTLE_SECONDS
from relay_server.robots.message_types import CUMULATIVE_TYPES


class StreamOptions(NamedTuple):
    """Options that a client requests for all its subscriptions.

    :param throttle_ms: least time between two messages of a topic, milliseconds; 0: every message
    :param thin: of topics with point clouds
    """

    throttle_ms: float = 0.0
    thin: link.Thinning | None = None

    def throttle_of(self, topic: str, type_name: str, publishers: int) -> float:
        """The throttle of a topic, milliseconds; 0 where the newest message does not replace the others.

        :param publishers: nodes that publish it
        """
        every = type_name in CUMULATIVE_TYPES or publishers > 1 or topic.startswith("/relay/")
        return 0.0 if every else self.throttle_ms


NO_OPTIONS = StreamOptions()


def stream_options(params: Mapping[str, Sequence[str]]) -> StreamOptions:
    """The options of a query.

    :raises Invalid: a value is not a number in its range, or there are a stride and a voxel
    """
    throttle = _number(params, "throttle", THROTTLE_SECONDS * 1000, "milliseconds")
    stride = _number(params, "stride", limits.STRIDE, "points")
    voxel = _number(params, "voxel", limits.VOXEL, "metres")
    if stride != int(stride):
        raise Invalid(f"'stride={stride:g}' is not a whole number of points")
    if stride and voxel:
        raise Invalid("'stride' and 'voxel' exclude each other; send one of them")
    thin = link.Thinning(stride=int(stride), voxel=voxel)
    return StreamOptions(throttle, thin if thin.thins else None)


def _number(params: Mapping[str, Sequence[str]], name: str, most: float, unit: str) -> float:
    values = params.get(name)
    if not values:
        return 0.0
    try:
        value = float(values[0][:32])
    except ValueError:
        value = math.nan
    if not 0 <= value <= most:
        # Without the value: after a wrong separator it contains the token, and the error is logged.
        raise Invalid(f"'{name}' must be a number of {unit} from 0 to {most:g}; separate options by &")
    return value
