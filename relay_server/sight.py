"""Who may have a robot's pictures, by whichever road: a topic that carries them takes the right to view them too."""

from __future__ import annotations

from collections.abc import Callable, Collection

from relay_protocol.rights import Operation, Verdict
from relay_server.registry import Presence

Judge = Callable[[Operation, str], Verdict]
"""Says whether somebody may do something to a resource of a robot: a permit's or rules' ``judge``."""

PICTURES = frozenset(
    {
        "sensor_msgs/msg/Image",
        "sensor_msgs/msg/CompressedImage",
        "stereo_msgs/msg/DisparityImage",
        "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
        "theora_image_transport/msg/Packet",
        "foxglove_msgs/msg/CompressedImage",
        "foxglove_msgs/msg/CompressedVideo",
        "foxglove_msgs/msg/RawImage",
    }
)
"""Types of topics that carry pictures."""


def carries_pictures(robot: Presence, topic: str, said: Collection[str] = ()) -> bool:
    """Whether a topic of a robot shows what a camera sees, as far as anybody knows; without a type it may.

    :param said: its types for those who hear it, where the robot's graph does not have it
    """
    known = robot.graph.topics.get(topic)
    types = (known.types if known is not None else ()) or said
    return not types or not PICTURES.isdisjoint(types) or any(each.name == topic for each in robot.cameras)


def may_hear(judge: Judge, robot: Presence, topic: str, said: Collection[str] = ()) -> Verdict:
    """May somebody hear a topic of a robot?

    :param said: as for :func:`carries_pictures`
    """
    verdict = judge(Operation.SUBSCRIBE, topic)
    if verdict.allowed and carries_pictures(robot, topic, said):
        return judge(Operation.VIEW, topic)
    return verdict
