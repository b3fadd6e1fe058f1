"""What is sent, made of what cameras give."""

from __future__ import annotations

from relay_protocol.errors import Invalid, MalformedMessage
from relay_protocol.image_check import look_at
from relay_protocol.limits import PICTURE_FRAME
from relay_protocol.link import VideoSettings
from robot_client.camera import formats
from robot_client.camera.encoding import Encoder, make_encoder
from robot_client.camera.formats import Pixels, Raw
from robot_client.camera.frame import Encoded, EncodeRequest, Frame, FrameFormat
from robot_client.camera.orientation import without_orientation
from robot_client.camera.transforms import plan_transforms

_HEAD = 13
"""Bytes of a frame that are not the picture's: kind, number, stamp (SPEC 2.1)."""

_AS_THE_CAMERA_HAS_IT = VideoSettings().quality
"""Who asks for this quality or a better one is served with the camera's own JPEG."""


def message_shot(stamp: int, arrived: float, cdr: bytes, compressed: bool) -> Frame:
    """A picture that came over ROS.

    :param cdr: the message
    :param compressed: whether it is a CompressedImage
    """

    def look() -> FrameFormat:
        return FrameFormat(*formats.looked_at(cdr, compressed))

    def jpeg() -> bytes | None:
        packed = formats.compressed(cdr)
        return packed.file if packed.kind == "jpeg" else None

    if compressed:
        return Frame(stamp, arrived, look, lambda: formats.unpacked(formats.compressed(cdr)), jpeg)
    return Frame(stamp, arrived, look, lambda: formats.image(cdr))


def pixels_shot(stamp: int, arrived: float, pixels: Pixels) -> Frame:
    """A picture that came without ROS.

    :param pixels: as in :class:`~robot_client.camera.formats.Raw`
    """
    high, wide = pixels.shape[:2]
    look = FrameFormat("bgr8" if pixels.ndim == 3 else "mono8", wide, high)
    return Frame(stamp, arrived, lambda: look, lambda: Raw(*look, pixels))


class FrameMaker:
    """Makes the pictures of one stream, one after the other, in whatever thread.

    :param settings: what was asked for
    """

    def __init__(self, settings: VideoSettings) -> None:
        self._settings = settings
        self._encoder: Encoder | None = None
        self._size = (0, 0)

    def make(self, shot: Frame, wish: EncodeRequest) -> Encoded:
        """Edit and encode a picture, or leave it as it is where that serves.

        :raises Invalid: it can't be shown like that
        :raises Unavailable: this robot can't encode it
        """
        made = self._as_it_is(shot, wish) or self._encoded(shot, wish)
        if len(made.body) + _HEAD > PICTURE_FRAME:
            other = "of less quality" if self._settings.codec == "jpeg" else "as JPEG"
            raise Invalid(
                f"the picture has {len(made.body)} bytes; at most {PICTURE_FRAME - _HEAD} are sent. "
                f"Ask for a smaller one, or {other}"
            )
        return made

    def _as_it_is(self, shot: Frame, wish: EncodeRequest) -> Encoded | None:
        wanted = self._settings
        if wish.reduced or wanted.codec != "jpeg" or wanted.quality < _AS_THE_CAMERA_HAS_IT:
            return None
        file = shot.jpeg()
        if file is None or len(file) + _HEAD > PICTURE_FRAME:
            return None
        look = shot.look()
        if plan_transforms(wanted, look.width, look.height).touches or not _goes_out(file):
            return None
        return Encoded(without_orientation(file), look.width, look.height, look.encoding)

    def _encoded(self, shot: Frame, wish: EncodeRequest) -> Encoded:
        raw = shot.raw()
        edits = plan_transforms(self._settings, raw.width, raw.height, wish.scale)
        size = (edits.width, edits.height)
        if self._encoder is None or size != self._size:
            self._encoder = make_encoder(self._settings.codec, *size, wish.fps)
            self._size = size
        pixels = edits.apply(raw.pixels, shot.stamp / 1e9) if edits.touches else raw.pixels
        body, _ = self._encoder.encode(pixels, wish.quality, wish.key)
        return Encoded(body, *size, raw.encoding)


def _goes_out(file: bytes) -> bool:
    """Whether the relay would pass this JPEG on: some cameras put two into a message, or more behind the end, which
    decoders don't mind but browsers should not get.
    """
    try:
        look_at("jpeg", file)
    except MalformedMessage:
        return False
    return True
