"""The robot's pose from messages of /tf and /tf_static, on given time."""

from __future__ import annotations

import math

import pytest
from geometry_msgs.msg import TransformStamped
from rclpy.serialization import serialize_message
from tf2_msgs.msg import TFMessage

from relay_protocol.errors import Unavailable
from robot_client.navigation.transform_buffer import TransformBuffer


def transforms(*links: str, x: float = 1.0) -> TFMessage:
    """Links as ``parent child``, each of which moves its child ahead."""
    made = TFMessage()
    for link in links:
        parent, child = link.split()
        each = TransformStamped(child_frame_id=child)
        each.header.frame_id = parent
        each.transform.translation.x = x
        each.transform.rotation.w = 1.0
        made.transforms.append(each)
    return made


def buffer(*static: str) -> TransformBuffer:
    made = TransformBuffer()
    made.add_static(transforms(*static))
    return made


def came(of: TransformBuffer, now: float, *links: str, x: float = 1.0) -> None:
    of.add(bytes(serialize_message(transforms(*links, x=x))), now)


def located(of: TransformBuffer, base: str = "base_link") -> tuple[float, float, float]:
    """x of the pose, and the times."""
    found = of.locate("map", base)
    return found.pose.x, found.odometry_at, found.localiser_at


def test_base_link_below_a_moving_base_footprint() -> None:
    made = buffer("base_footprint base_link", "base_link laser")
    came(made, 1.0, "map odom")
    came(made, 2.0, "odom base_footprint")
    assert located(made) == (3.0, 2.0, 1.0)
    came(made, 3.0, "odom base_footprint", x=5.0)
    assert located(made) == (7.0, 3.0, 1.0)
    came(made, 4.0, "map odom", x=2.0)
    assert located(made) == (8.0, 3.0, 4.0)


def test_static_transforms_that_come_last_complete_the_chain() -> None:
    made = buffer()
    came(made, 1.0, "map odom", "odom base_footprint")
    with pytest.raises(Unavailable, match="no transforms connect"):
        made.locate("map", "base_link")
    made.add_static(transforms("base_footprint base_link"))
    assert located(made) == (3.0, 1.0, 1.0)


@pytest.mark.parametrize(
    ("static", "times", "expected"),
    [
        (("map odom",), {"odom base_link": 2.0}, (2.0, math.inf)),
        ((), {"map base_link": 2.0}, (2.0, 2.0)),
        (("odom base_link",), {"map odom": 2.0}, (2.0, 2.0)),
        ((), {"map odom": 1.0, "odom lift": 2.0, "lift base_link": 3.0}, (2.0, 1.0)),
        ((), {"odom map": 1.0, "odom base_link": 2.0}, (2.0, 1.0)),
        (("base_link laser",), {"map odom": 1.0, "odom base_link": 2.0, "base_link arm": 0.0}, (2.0, 1.0)),
    ],
    ids=["map is fixed", "no odometry", "fixed to odom", "two joints", "map below odom", "frames beside it"],
)
def test_ages_are_those_of_the_chain(
    static: tuple[str, ...], times: dict[str, float], expected: tuple[float, float]
) -> None:
    made = buffer(*static)
    for link, now in times.items():
        came(made, now, link)
    assert located(made)[1:] == expected


def test_static_transforms_alone_are_no_pose() -> None:
    made = buffer("map odom", "odom base_link")
    with pytest.raises(Unavailable, match="no transform on /tf moves 'base_link'"):
        made.locate("map", "base_link")


def test_a_seldom_localiser_is_not_lost_among_many_messages() -> None:
    made = buffer()
    came(made, 0.0, "map odom")
    for number in range(1000):
        came(made, float(number), "odom base_link")
    assert located(made) == (2.0, 999.0, 0.0)
