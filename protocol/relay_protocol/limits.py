"""Sizes, times and counts that both ends agree on. Imports nothing of ours.

Sizes are bytes, times are seconds, unless a name says otherwise.
"""

KIB = 1024
MIB = 1024 * KIB

HANDSHAKE_FRAME = 16 * KIB
"""Largest frame on a robot link that has not proved who it is."""

ROBOT_FRAME = 16 * MIB
"""Largest frame a proven robot may send on a channel link (a point cloud or a raw picture)."""

ROBOT_SAMPLE = 64 * MIB
"""Largest sample a robot may send in parts, unless the relay or the robot is set otherwise."""

LEAST_SAMPLE = 1 * MIB
MOST_SAMPLE = 1024 * MIB
"""What the largest sample may be set to."""

CONTROL_FRAME = 1 * MIB
"""Largest frame a robot may send on its control link."""

JSON_BODY = 1 * MIB
"""Largest JSON text taken from a robot: a sample in JSON, the JSON values of an answer."""

GRAPH_BYTES = 8 * MIB
"""Memory the relay spends on the mirror of one robot's graph."""

GRAPH_ENDS = 1024
"""Most types of a topic or service, and most nodes at each of its ends."""

TYPE_TEXTS = 16 * MIB
"""Most characters of type definitions taken from one robot."""

INTERFACES = 8192
"""Most names of types a robot tells of at once."""

PICTURE_FRAME = 4 * MIB
"""Largest frame a robot may send on a video link: one picture as JPEG or PNG, or one of H.264."""

PICTURE_SIDE = 8192
"""Most pixels of a picture in a row or a column."""

CAMERAS = 256
"""Most cameras of a robot."""

PARTS_BYTES = 2 * ROBOT_FRAME
"""Most bytes of samples that have come in part only, over one link."""

FRAGMENTS = 16
"""Most messages a client may have sent in part only."""

FRAGMENT_SECONDS = 10.0
"""A message of which a fragment is missing for so long is given up."""

LABEL = 255
"""Longest fact a robot tells of itself (host, agent, …), in characters."""

FACTS = 64
"""Most further facts (``extra``), and most names in each list of what a robot counts as motion."""

WORDS = 4096
"""Longest sentence for people that comes over a robot link, in characters; longer ones are cut."""

COMMAND_FRAME = 4 * MIB
"""Largest JSON message the relay sends to a robot."""

ROBOT_MESSAGE = 16 * MIB
"""Largest sample or command the relay sends to a robot, with the head of its frame."""

CLIENT_MESSAGE = 10_000_000
"""Largest websocket message, and frame, a client may send, unless the relay is set otherwise; as rosbridge_server's."""

UNPROVEN_BYTES = 64 * KIB
"""What a connection may send before it is authenticated."""

UNPROVEN_SECONDS = 10.0
"""How long a connection may take to authenticate, an absolute deadline."""

JSON_DEPTH = 64
"""Deepest nesting of arrays and objects in a JSON message."""

TYPE_DEFINITION = 256 * KIB
"""Largest .msg/.srv text, with all types it contains, taken from a robot."""

NAME = 255
"""Longest name of a topic, service, type or node, in characters (as in DDS)."""

NAME_BYTES = 256
"""Longest name of a user, group, realm, OAuth client or header field that is read at all."""

ROBOT_NAME = 63
"""Longest name of a robot, in characters (a DNS label)."""

ENROLMENT_SECONDS = 15 * 60
"""An enrolment code is good for this long, once."""

TICKET_SECONDS = 60
"""A single-use ticket for an address of a client is good for this long."""

CHANNEL_TICKET_SECONDS = 30
"""A robot has this long to join a channel or a stream it was asked to open."""

HEARTBEAT_SECONDS = 1.25
"""Each end of a robot link pings this often; three missed and the link is lost, and people are told within 5 s."""

HEARTBEATS_MISSED = 3

COMMAND_DEADLINE_MS = 500
"""No motion command older than this is executed."""

STOP_WITHIN_MS = 500
"""A robot stands still within this time of its last valid motion command."""

SUPPRESS_MS = (50, 200)
"""Least and greatest time, in milliseconds, for which a topic's commands come from others than the holder."""

INHIBIT_MS = 60_000
"""Greatest time, in milliseconds, for which a topic says nothing."""

SOURCES = 256
"""Most connections a suppression names."""

LINGER_SECONDS = 5.0
"""A channel stays open this long after its last client."""

CALL_SECONDS = 30.0
"""A service call that names no timeout is given up after this long."""
