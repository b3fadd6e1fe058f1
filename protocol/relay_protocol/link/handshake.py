"""Before the robot is known: it says who it is and proves it, and the relay answers."""

from __future__ import annotations

from relay_protocol.link.fields import Few, Label
from relay_protocol.message import Message


class Hello(Message, frozen=True, kw_only=True):
    """Robot: this is who I am going to prove to be.

    :param key: fingerprint of the public key that will sign, see :func:`relay_protocol.identity.fingerprint`
    :param encodings: encodings of samples the robot speaks, best first: ``cdr``, ``json``
    :param agent: software and version, for people
    """

    version: int
    robot: Label
    key: Label
    encodings: Few
    agent: Label = ""


class Challenge(Message, frozen=True, kw_only=True):
    """Relay: sign this. ``nonce`` is 32 random bytes in base64, good for this connection only."""

    nonce: str
    relay: str


class Prove(Message, frozen=True, kw_only=True):
    """Robot: the Ed25519 signature (base64) of :func:`relay_protocol.identity.proof_text`."""

    signature: Label


class Enroll(Message, frozen=True, kw_only=True):
    """Robot: register my public key (32 bytes, base64) by this code of one use."""

    version: int
    robot: Label
    code: Label
    public_key: Label
    agent: Label = ""


class Enrolled(Message, frozen=True, kw_only=True):
    """Relay: done; dial again with ``hello``. The robot keeps ``relay`` and refuses another name later."""

    robot: str
    relay: str


class Join(Message, frozen=True, kw_only=True):
    """Robot, on a new connection: this is the channel you asked me to open.

    :param parts: whether the robot takes samples in parts
    """

    version: int
    ticket: Label
    parts: bool = False


class Joined(Message, frozen=True, kw_only=True):
    """Relay: go on. ``at`` is the relay's monotonic clock (ns), the first estimate of the offset."""

    channel: str
    at: int


class Refused(Message, frozen=True, kw_only=True):
    """Relay: no, and the connection ends.

    :param retry_after: seconds after which trying again makes sense; ``None`` when only a person can help
    """

    reason: str
    code: str = "refused"
    retry_after: float | None = None


class Welcome(Message, frozen=True, kw_only=True):
    """Relay: you are registered.

    :param session: name of this registration, for logs on both ends
    :param heartbeat: seconds between pings, each way
    :param frame_limit: largest frame the robot may send on its channel links, bytes
    :param sample_limit: largest sample it may send there in parts, bytes; 0 for what fits into a frame
    """

    session: str
    heartbeat: float
    frame_limit: int
    sample_limit: int = 0


Opening = Hello | Prove | Enroll | Join
"""What a robot may say before it is known."""

OpeningReply = Challenge | Welcome | Enrolled | Joined | Refused
"""What the relay answers to that."""
