"""Message types of ROS that are treated in a way of their own: camera images, and streams whose newest message does
not replace the others.
"""

from __future__ import annotations

VIDEO_TYPES = frozenset(
    {
        "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
        "foxglove_msgs/msg/CompressedVideo",
        "theora_image_transport/msg/Packet",
    }
)
"""Types of encoded video. A frame can't be decoded without those before it."""

IMAGE_TYPES = VIDEO_TYPES | {
    "foxglove_msgs/msg/CompressedImage",
    "foxglove_msgs/msg/RawImage",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/Image",
    "stereo_msgs/msg/DisparityImage",
}
"""Types of topics that carry images."""

CUMULATIVE_TYPES = VIDEO_TYPES | {
    "audio_common_msgs/msg/AudioData",
    "audio_common_msgs/msg/AudioDataStamped",
    "diagnostic_msgs/msg/DiagnosticArray",
    "foxglove_msgs/msg/FrameTransform",
    "foxglove_msgs/msg/FrameTransforms",
    "foxglove_msgs/msg/Log",
    "foxglove_msgs/msg/RawAudio",
    "foxglove_msgs/msg/SceneUpdate",
    "lifecycle_msgs/msg/TransitionEvent",
    "map_msgs/msg/OccupancyGridUpdate",
    "map_msgs/msg/PointCloud2Update",
    "nav2_msgs/msg/BehaviorTreeLog",
    "nav2_msgs/msg/CostmapUpdate",
    "rcl_interfaces/msg/Log",
    "rcl_interfaces/msg/ParameterEvent",
    "rosgraph_msgs/msg/Clock",
    "tf2_msgs/msg/TFMessage",
    "visualization_msgs/msg/ImageMarker",
    "visualization_msgs/msg/InteractiveMarkerUpdate",
    "visualization_msgs/msg/Marker",
    "visualization_msgs/msg/MarkerArray",
}
"""Types of which the newest message does not replace the others: each adds to those before, or is an event."""
