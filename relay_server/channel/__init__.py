"""One channel for each robot in use: one uplink to the robot, many sessions on the other side.

``lifecycle`` is the channel itself, a table of states; its parts each keep one kind of what clients want of the
robot: ``subscriptions``, ``publications``, ``calls``, and the type ``definitions`` they need. What clients want
is remembered, so a robot or a link that goes away and comes back is taken up again without clients noticing;
``asking`` is for what is asked once.
"""

from relay_server.channel.hub import Channels
from relay_server.channel.lifecycle import Channel
from relay_server.channel.states import State
from relay_server.channel.wire import ChannelLink, Member, resolve

__all__ = ["Channel", "ChannelLink", "Channels", "Member", "State", "resolve"]
