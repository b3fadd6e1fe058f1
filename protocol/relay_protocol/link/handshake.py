"""The handshake of a robot link: the robot names itself and proves its identity, and the relay answers (SPEC 2.3)."""

from __future__ import annotations

from relay_protocol.link.fields import Label, NameList
from relay_protocol.message import Message


class Hello(Message, frozen=True, kw_only=True):
    """Robot: start of the handshake of a control link.

    :param key: fingerprint of the public key that will sign, see :func:`relay_protocol.identity.fingerprint`
    :param encodings: encodings of samples the robot supports, best first: ``cdr``, ``json``
    :param agent: software and version, for display
    :param functions: whether this is a function link: it calls functions, and does not register the robot
    """

    version: int
    robot: Label
    key: Label
    encodings: NameList
    agent: Label = ""
    functions: bool = False


class Challenge(Message, frozen=True, kw_only=True):
    """Relay: sign this nonce.

    :param nonce: 32 random bytes in base64, valid for this connection only
    :param relay: the relay's name, which is signed too
    """

    nonce: str
    relay: str


class Prove(Message, frozen=True, kw_only=True):
    """Robot: the answer to ``challenge``.

    :param signature: Ed25519 signature (base64) of :func:`relay_protocol.identity.proof_text`
    """

    signature: Label


class Enroll(Message, frozen=True, kw_only=True):
    """Robot: register a public key.

    :param code: single-use enrolment code
    :param public_key: 32 bytes, base64
    """

    version: int
    robot: Label
    code: Label
    public_key: Label
    agent: Label = ""


class Enrolled(Message, frozen=True, kw_only=True):
    """Relay: the key is registered; dial again with ``hello``.

    :param relay: the relay's name; the robot stores it and refuses another one later
    """

    robot: str
    relay: str


class Join(Message, frozen=True, kw_only=True):
    """Robot, on a new connection: this is the channel or stream the relay asked for.

    :param parts: whether the robot accepts samples in parts
    """

    version: int
    ticket: Label
    parts: bool = False


class Joined(Message, frozen=True, kw_only=True):
    """Relay: the ticket is valid; the link is open.

    :param at: the relay's monotonic clock, nanoseconds: the first estimate of the clock offset
    """

    channel: str
    at: int


class Refused(Message, frozen=True, kw_only=True):
    """Relay: the handshake failed, and the connection ends.

    :param code: machine-readable reason
    :param retry_after: seconds after which another attempt may succeed; ``None`` when the cause must be removed first
    """

    reason: str
    code: str = "refused"
    retry_after: float | None = None


class Welcome(Message, frozen=True, kw_only=True):
    """Relay: the robot is registered.

    :param session: name of this registration, for the logs of both ends
    :param heartbeat: seconds between pings, in each direction
    :param frame_limit: largest frame the robot may send on its channel links, bytes
    :param sample_limit: largest sample it may send there in parts, bytes; 0 when a sample must fit into one frame
    """

    session: str
    heartbeat: float
    frame_limit: int
    sample_limit: int = 0


HandshakeRequest = Hello | Prove | Enroll | Join
"""What a robot may send before it is authenticated."""

HandshakeReply = Challenge | Welcome | Enrolled | Joined | Refused
"""What the relay answers."""
