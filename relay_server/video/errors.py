"""Errors of camera streams.

::

    Unavailable
    ├── NoFrame                 no frame came in time
    ├── EncoderUnavailable      the robot cannot encode H.264
    └── TooManyStreamStarts     a user starts streams too fast
"""

from __future__ import annotations

from relay_protocol.errors import Unavailable
from relay_server.common.errors import NothingReceived

NO_CAMERA = "there is no such camera, or you have no right to view it"
"""One answer for both cases, so that it does not disclose which cameras exist."""


class NoFrame(NothingReceived):
    """The stream could be opened, but no frame was received in time."""


class EncoderUnavailable(Unavailable):
    """The robot cannot encode this stream as H.264; another codec may work."""

    code = "not_made"


class TooManyStreamStarts(Unavailable):
    """A user starts streams of one robot too fast.

    :param retry_after: seconds until the user may start another one
    """

    code = "too_often"

    def __init__(self, robot: str, retry_after: float) -> None:
        super().__init__(
            f"you start streams of robot {robot} too fast; try again in {int(retry_after) + 1} s"
        )
        self.retry_after = retry_after
