"""The contract between relay, robots and clients: frames, messages, ROS types, rights, errors, limits.

Nothing here opens a socket. Bytes and objects go in, objects and bytes come out.
The words are in ``protocol/spec``; these modules are the same contract in code.
"""

PROTOCOL_VERSION = 1
"""Version of the robot link. A peer with another one is refused in words."""
