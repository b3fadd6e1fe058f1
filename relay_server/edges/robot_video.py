"""What a robot's connection is for when it is the link of a stream of pictures (SPEC section 2.6)."""

from __future__ import annotations

from collections.abc import Callable

from relay_protocol import jsontext, limits, link
from relay_protocol.errors import MalformedMessage
from relay_protocol.frames import SAMPLE_HEAD, PictureJoiner, PicturePart, SampleFrame, VideoFrame
from relay_protocol.limits import KIB
from relay_server.bucket import TokenBucket
from relay_server.edges.robots import RobotConnection, Role
from relay_server.video import Stream

LEAST_PART = KIB
"""Bytes of a part of a picture, at least, but of the last and now and then of the first: each is answered."""

QUESTIONS_A_SECOND = 1.0
QUESTIONS_AT_ONCE = 8
"""First parts that may be smaller: a robot measures the round trip by one, every few seconds."""


class VideoEnd(Role):
    """The robot's end of a stream.

    :param seconds: a monotonic clock
    """

    def __init__(self, stream: Stream, connection: RobotConnection, seconds: Callable[[], float]) -> None:
        self._stream = stream
        self._questions = TokenBucket(QUESTIONS_A_SECOND, QUESTIONS_AT_ONCE, seconds)
        self._connection = connection
        self._parts = PictureJoiner(limits.PICTURE_FRAME - SAMPLE_HEAD)

    def message(self, body: bytes) -> None:
        """What it plays, or that it does not."""
        if len(body) > limits.JSON_BODY:
            raise MalformedMessage(f"JSON of more than {limits.JSON_BODY} bytes is not taken on a video link")
        message = jsontext.decode(link.robot_video_decoder, body)
        if isinstance(message, (link.Ping, link.Pong)):
            self._connection.heartbeat(message)
        elif isinstance(message, link.Bye):
            self._connection.close("bye")
        else:
            self._stream.message(message)

    def sample(self, frame: SampleFrame) -> None:
        """Topics have links of their own."""
        raise MalformedMessage("samples go over the channel link, not the link of a stream")

    def picture(self, frame: VideoFrame | PicturePart) -> None:
        """A picture of the stream, or a part of one, which is answered too."""
        if isinstance(frame, VideoFrame):
            self._parts.drop()
            self._stream.picture(frame)
            return
        last = frame.offset + len(frame.body) >= frame.total
        if len(frame.body) < LEAST_PART and not last and (frame.offset or not self._questions.take()):
            raise MalformedMessage(f"parts of a picture have at least {LEAST_PART} bytes, but for the last")
        whole = self._parts.join(frame)
        if whole is not None:
            self._stream.picture(whole)
        else:
            self._stream.part()
            self._connection.send(link.Took(number=frame.number, upto=self._parts.size))

    def lost(self, reason: str) -> None:
        """The link has ended."""
        self._stream.lost(self._connection)
