"""Options for slow links: the query of a Foxglove URL, and the robot's requests for several clients."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol.errors import Invalid
from relay_protocol.link import Thinning
from relay_server.channels.thinning import least_thinning
from relay_server.foxglove.options import StreamOptions, stream_options


@pytest.mark.parametrize(
    ("params", "options"),
    [
        ({}, StreamOptions()),
        ({"throttle": ["250"]}, StreamOptions(250.0)),
        ({"throttle": ["0"], "stride": ["1"]}, StreamOptions()),
        ({"stride": ["4"]}, StreamOptions(0.0, Thinning(stride=4))),
        ({"voxel": ["0.1"], "token": ["x"]}, StreamOptions(0.0, Thinning(voxel=0.1))),
    ],
)
def test_options_of_a_query(params: Any, options: StreamOptions) -> None:
    assert stream_options(params) == options


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("throttle", value) for value in ("-1", "nan", "fast", "", "1e9")),
        *(("stride", value) for value in ("2.5", "-2", "1001")),
        *(("voxel", value) for value in ("inf", "-0.1", "1001")),
    ],
)
def test_a_wrong_option_is_refused_with_its_name(name: str, value: str) -> None:
    with pytest.raises(Invalid, match=name):
        stream_options({name: [value]})


@pytest.mark.parametrize("name", ["throttle", "stride", "voxel"])
def test_a_token_after_a_wrong_separator_is_not_in_the_error(name: str) -> None:
    """It is logged."""
    with pytest.raises(Invalid, match="separate options by &") as refused:
        stream_options({name: ["4?token=swb_secret"]})
    assert "swb_" not in str(refused.value)


def test_stride_and_voxel_exclude_each_other() -> None:
    with pytest.raises(Invalid, match="exclude each other"):
        stream_options({"stride": ["2"], "voxel": ["1"]})


@pytest.mark.parametrize(
    ("topic", "type_name", "publishers", "throttle"),
    [
        ("/scan", "sensor_msgs/msg/LaserScan", 1, 100.0),
        ("/scan", "sensor_msgs/msg/LaserScan", 0, 100.0),
        ("/camera", "sensor_msgs/msg/Image", 1, 100.0),
        ("/joint_states", "sensor_msgs/msg/JointState", 2, 0.0),
        ("/relay/control", "std_msgs/msg/String", 1, 0.0),
        *(
            ("/arm/it", type_name, 1, 0.0)
            for type_name in (
                "diagnostic_msgs/msg/DiagnosticArray",
                "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
                "foxglove_msgs/msg/CompressedVideo",
                "foxglove_msgs/msg/FrameTransform",
                "foxglove_msgs/msg/FrameTransforms",
                "foxglove_msgs/msg/Log",
                "foxglove_msgs/msg/SceneUpdate",
                "map_msgs/msg/OccupancyGridUpdate",
                "rcl_interfaces/msg/Log",
                "rosgraph_msgs/msg/Clock",
                "tf2_msgs/msg/TFMessage",
                "theora_image_transport/msg/Packet",
                "visualization_msgs/msg/InteractiveMarkerUpdate",
                "visualization_msgs/msg/MarkerArray",
            )
        ),
    ],
)
def test_only_topics_whose_newest_message_replaces_the_others_are_throttled(
    topic: str, type_name: str, publishers: int, throttle: float
) -> None:
    assert StreamOptions(100.0).throttle_of(topic, type_name, publishers) == throttle


@pytest.mark.parametrize(
    ("requests", "least"),
    [
        ([], None),
        ([None], None),
        ([Thinning(stride=4)], Thinning(stride=4)),
        ([Thinning(stride=4), Thinning(stride=2)], Thinning(stride=2)),
        ([Thinning(voxel=0.5), Thinning(voxel=0.1)], Thinning(voxel=0.1)),
        ([Thinning(voxel=0.5), Thinning(stride=2)], None),
        ([Thinning(stride=4), None], None),
        ([Thinning(stride=4), Thinning(stride=1)], None),
    ],
)
def test_the_robot_sends_what_the_most_demanding_client_needs(
    requests: list[Thinning | None], least: Thinning | None
) -> None:
    assert least_thinning(requests) == least
