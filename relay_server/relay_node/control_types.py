"""The types of what the relay offers about control, as ROS 2 writes them (SPEC section 1.7)."""

from __future__ import annotations

_LINE = "=" * 80

CONTROL = "switchboard_msgs/msg/Control"

CONTROL_TEXT = f"""string robot
string state
Holder holder
Request request
Stopped stopped
bool moving
Suppressed[] suppressed
Inhibited[] inhibited
LevelLimits limits
You you
{_LINE}
MSG: switchboard_msgs/msg/Holder
string user
uint32 client
float64 since
bool you
bool implicit
{_LINE}
MSG: switchboard_msgs/msg/Request
string user
uint32 client
float64 since
string why
bool you
float64 until
{_LINE}
MSG: switchboard_msgs/msg/Stopped
string by
string why
float64 since
bool told
{_LINE}
MSG: switchboard_msgs/msg/Suppressed
string resource
uint32[] sources
string by
uint32 ms
{_LINE}
MSG: switchboard_msgs/msg/Inhibited
string resource
bool hold
string by
uint32 ms
{_LINE}
MSG: switchboard_msgs/msg/LevelLimits
Limits operator
Limits owner
{_LINE}
MSG: switchboard_msgs/msg/Limits
float64 linear
float64 angular
float64 linear_acceleration
float64 angular_acceleration
{_LINE}
MSG: switchboard_msgs/msg/You
uint32 client
bool may_control
bool may_resume
"""

_ANSWER = "---\nbool success\nstring message\n"
_ORDER = ("switchboard_msgs/srv/Order", f"string why\n{_ANSWER}")
_REPLY = ("switchboard_msgs/srv/Reply", f"string why\nuint32 client\n{_ANSWER}")
_STOP = ("switchboard_msgs/srv/Stop", f"string why\n{_ANSWER}bool done\n")

SERVICES = {
    "/relay/take_control": _ORDER,
    "/relay/release_control": _ORDER,
    "/relay/grant_control": _REPLY,
    "/relay/refuse_control": _REPLY,
    "/relay/stop": _STOP,
    "/relay/resume": _ORDER,
    "/relay/suppress": ("switchboard_msgs/srv/Suppress", f"string resource\nuint32 ms 100\n{_ANSWER}"),
    "/relay/inhibit": (
        "switchboard_msgs/srv/Inhibit",
        f"string resource\nuint32 ms 1000\nbool hold\n{_ANSWER}",
    ),
}
"""Each with its type and that type's definition."""
