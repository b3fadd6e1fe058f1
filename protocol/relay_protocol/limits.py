"""Sizes, times and counts that both ends agree on (SPEC 5). Imports nothing of ours.

Sizes are in bytes and times in seconds, unless the name says otherwise.
"""

KIB = 1024
MIB = 1024 * KIB

HANDSHAKE_FRAME = 16 * KIB
"""Largest frame on a robot link that is not authenticated."""

ROBOT_FRAME = 16 * MIB
"""Largest frame an authenticated robot may send on a channel link, for example a point cloud."""

ROBOT_SAMPLE = 64 * MIB
"""Largest sample a robot may send in parts; default of a setting of relay and robot."""

MIN_SAMPLE = 1 * MIB
MAX_SAMPLE = 1024 * MIB
"""Range of that setting."""

CONTROL_FRAME = 1 * MIB
"""Largest frame a robot may send on its control link."""

JSON_BODY = 1 * MIB
"""Largest JSON text taken from a robot: a sample in JSON, the JSON values of an answer."""

GRAPH_BYTES = 8 * MIB
"""Most memory of the relay's mirror of one robot's graph."""

GRAPH_NODES = 1024
"""Most types of a topic or service, and most publishers, subscribers or servers of it."""

TYPE_TEXTS = 16 * MIB
"""Most characters of type definitions taken from one robot."""

INTERFACES = 8192
"""Most type names in one message of a robot."""

VIDEO_FRAME = 4 * MIB
"""Largest frame a robot may send on a video link: one image as JPEG, PNG or H.264."""

IMAGE_SIDE = 8192
"""Largest width and height of a camera frame, pixels."""

CAMERAS = 256
"""Most cameras of a robot."""

STRIDE = 1000
"""Largest stride at which points of a cloud are kept."""

VOXEL = 1000.0
"""Largest side of a cube of which one point is kept, metres."""

ASSET = 64 * MIB
"""Largest file that a robot sends as an asset, for example a mesh."""

ASSET_PART = 128 * KIB
"""Most bytes of an asset in one message."""

ASSET_URI = 1024
"""Longest URI of an asset, characters."""

MODULES = 64
"""Most modules of a robot."""

FILE_NAME = 1024
"""Longest name of a file of a robot with its folders, bytes of UTF-8."""

FILE_PART = 16 * KIB
"""Largest part of a file that is uploaded."""

FILE_UNCONFIRMED = 512 * KIB
"""Most bytes of files on one link that the relay has not confirmed yet."""

FILE_UPLOADS = 16
"""Most files that are uploaded at a time over one link."""

LOG_LINES = 500
"""Most lines of a module's log in one answer."""

LOG_BYTES = 256 * KIB
"""Most bytes of text in one answer with lines of a log."""

LOG_WAIT_SECONDS = 30.0
"""Longest time a robot waits for a new line before it answers."""

PROCESSES = 512
"""Most processes of a robot in one measurement."""

INCOMPLETE_SAMPLE_BYTES = 2 * ROBOT_FRAME
"""Most bytes of incomplete samples on one link."""

PART_SECONDS = 60.0
"""An incomplete sample on a robot link is dropped when no part of it has come for this time."""

INCOMPLETE_MESSAGES = 16
"""Most incomplete messages of one client (rosbridge fragments)."""

FRAGMENT_SECONDS = 10.0
"""An incomplete message is discarded after this time."""

MESSAGE_SECONDS = 30.0
MESSAGE_RATE = 16 * KIB
"""A client must finish a message within this time, and one second more for each so many bytes of it."""

UNFINISHED_MESSAGES = 4
"""Unfinished messages of one user have as many bytes together, over all connections, as so many largest messages."""

LABEL_LENGTH = 255
"""Longest fact about a robot (host, agent, …), characters."""

LIST_ITEMS = 64
"""Most entries of a short list or map of a robot, for example ``extra`` facts or patterns of motion topics."""

REASON_LENGTH = 500
"""Longest reason of a stop or of another request about control that is kept, characters; longer ones are cut."""

STOP_ID_LENGTH = 64
"""Longest id of a stop that a client makes, characters; a longer one counts as none."""

TEXT_LENGTH = 4096
"""Longest text for display on a robot link, characters; longer ones are cut."""

RELAY_JSON_FRAME = 4 * MIB
"""Largest frame with a JSON message that the relay sends to a robot."""

RELAY_FRAME = 16 * MIB
"""Largest frame that the relay sends to a robot: one with a sample or a command."""

CLIENT_MESSAGE = 10_000_000
"""Largest websocket message of a client, as in rosbridge_server; default of a setting of the relay."""

UNAUTHENTICATED_BYTES = 64 * KIB
"""Most bytes a connection may send before it is authenticated."""

HTTP_BODY = 48 * KIB
"""Largest body of an HTTP request; with it a connection takes less than 64 KiB of the relay's memory."""

FUNCTION_BYTES = 16 * MIB
"""Largest arguments, and largest result, of a call of a function, as MessagePack."""

FUNCTION_BODY = 24 * MIB
"""Largest body of an HTTP request that calls a function: arguments in base64 take a third more."""

FILE_BODY = 8 * MIB
"""Largest body of an HTTP request that uploads a file, or a part of one."""

UNAUTHENTICATED_SECONDS = 10.0
"""A connection must authenticate within this time after it was accepted."""

JSON_DEPTH = 64
"""Deepest nesting of arrays and objects in a JSON message."""

TYPE_DEFINITION = 256 * KIB
"""Largest .msg/.srv text, with all types it contains, taken from a robot."""

NAME = 255
"""Longest name of a topic, service, type or node, characters (as in DDS)."""

NAME_BYTES = 256
"""Longest name of a user, group, realm, OAuth client or header field; longer ones are rejected unread."""

ROBOT_NAME = 63
"""Longest name of a robot, characters (a DNS label)."""

ENROLMENT_SECONDS = 15 * 60
"""Validity of an enrolment code, which works once."""

TICKET_SECONDS = 60
"""Validity of a single-use ticket in a client's URL."""

CHANNEL_TICKET_SECONDS = 30
"""A robot must join a channel or stream within this time after the request."""

HEARTBEAT_SECONDS = 1.25
"""Interval of pings in each direction. After three without an answer the link is lost, so users see it within 5 s."""

HEARTBEATS_MISSED = 3
"""Pings in a row without an answer after which a link is lost."""

COMMAND_DEADLINE_MS = 500
"""Older motion commands are dropped."""

STOP_WITHIN_MS = 500
"""A robot stands still within this time of its last valid motion command."""

SUPPRESS_MS = (50, 200)
"""Shortest and longest suppression of a topic, milliseconds."""

INHIBIT_MS = 60_000
"""Longest inhibition of a topic, milliseconds."""

SOURCES = 256
"""Most connections in one suppression."""

LINGER_SECONDS = 5.0
"""A channel stays open for this time after its last session."""

CALL_SECONDS = 30.0
"""Default timeout of a service call."""
