"""Video over HTTP and websocket: addresses below ``/robots/<robot>/video`` (SPEC section 1.8)."""

from relay_server.edges.video.resource import Video
from relay_server.edges.video.socket import VideoFactory

__all__ = ["Video", "VideoFactory"]
