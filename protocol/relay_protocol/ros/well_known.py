"""Definitions of a few types of ``std_msgs``, ``std_srvs`` and ``geometry_msgs`` (ROS 2, Humble and later).

Small robots that support only JSON cannot send type definitions. Messages to them are still checked when the type is
one of these.
"""

from __future__ import annotations

_LINE = "=" * 80
_VECTOR = f"{_LINE}\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
_TWIST = "Vector3 linear\nVector3 angular\n"
_NUMBERS = ["Int8", "Int16", "Int32", "Int64", "UInt8", "UInt16", "UInt32", "UInt64", "Float32", "Float64"]

TEXTS = {
    "geometry_msgs/msg/Twist": _TWIST + _VECTOR,
    "geometry_msgs/msg/TwistStamped": (
        f"std_msgs/Header header\nTwist twist\n{_LINE}\nMSG: geometry_msgs/Twist\n{_TWIST}{_VECTOR}"
        f"{_LINE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    ),
    "std_msgs/msg/Bool": "bool data\n",
    "std_msgs/msg/Empty": "",
    "std_msgs/msg/String": "string data\n",
    **{f"std_msgs/msg/{name}": f"{name.lower()} data\n" for name in _NUMBERS},
    "std_srvs/srv/Empty": "---\n",
    "std_srvs/srv/SetBool": "bool data\n---\nbool success\nstring message\n",
    "std_srvs/srv/Trigger": "---\nbool success\nstring message\n",
}
"""Texts by full names, in the layout of :class:`relay_protocol.link.channel.TypeDefinition`."""
