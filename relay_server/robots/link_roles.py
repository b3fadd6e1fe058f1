"""What a robot's connection is for when it is the link of a stream of pictures (SPEC section 2.6)."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from sqlalchemy.orm import Session
from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_db import queries
from relay_db.queries import RobotRecord
from relay_protocol import PROTOCOL_VERSION, identity, jsontext, limits, link
from relay_protocol.errors import Invalid, MalformedMessage, Refused, Unavailable
from relay_protocol.frames import SAMPLE_HEAD, PictureJoiner, PicturePart, SampleFrame, VideoFrame
from relay_protocol.limits import KIB
from relay_protocol.realms import parted
from relay_server.auth import login_limiter, passwords
from relay_server.auth.login_limiter import LoginLimiter
from relay_server.channels.channel import Channel
from relay_server.channels.channels import Channels
from relay_server.common.database import AsyncDatabase
from relay_server.common.token_bucket import TokenBucket
from relay_server.control.controllers import Controllers
from relay_server.events.bus import EventBus
from relay_server.robots.connection import LinkRole, RobotConnection
from relay_server.robots.registry import REPLACE_SECONDS, RobotRegistry, RobotState
from relay_server.video.stream import CameraStream
from relay_server.video.streams import CameraStreams

MOST_PATIENCE = 60.0
FLAPPING_SECONDS = 2 * MOST_PATIENCE
"""Who replaces a registration younger than this doubles the time the next one must wait, up to
:data:`MOST_PATIENCE`: two daemons with one key would take the robot from each other for ever."""

CLAIMED = 2 * limits.ROBOT_NAME
"""Characters of what somebody said he is that are put on record."""

FAILURES_OF_NETWORK = 1000
"""Failed proofs and enrolments of one network: many robots may dial from behind one address."""


@dataclass(frozen=True)
class RobotLinkContext:
    """What the roles of robot connections share.

    :param relay: the relay's name, part of what robots sign
    :param seconds: a monotonic clock
    :param wall: Unix time in seconds
    """

    relay: str
    store: AsyncDatabase
    registry: RobotRegistry
    channels: Channels
    videos: CameraStreams
    desks: Controllers
    journal: EventBus
    seconds: Callable[[], float]
    wall: Callable[[], float]
    failures: LoginLimiter = field(init=False)

    def __post_init__(self) -> None:
        failures = LoginLimiter(self.seconds, FAILURES_OF_NETWORK, login_limiter.robot)
        object.__setattr__(self, "failures", failures)


class HandshakeRole(LinkRole):
    """A connection that has not said yet, or not proved, what it is."""

    def __init__(self, hall: RobotLinkContext, connection: RobotConnection) -> None:
        self._hall = hall
        self._connection = connection
        self._hello: link.Hello | None = None
        self._nonce = b""

    def message(self, body: bytes) -> None:
        """``hello``, ``enroll`` or ``join`` first; after ``hello``, ``prove``."""
        message = jsontext.decode(link.opening_decoder, body)
        if isinstance(message, link.Prove):
            if self._hello is None:
                raise MalformedMessage("'prove' came before 'hello'")
            hello, self._hello = self._hello, None
            self._run(self._prove(hello, message))
        elif self._nonce:
            raise MalformedMessage(f"'{link.lower_tag(type(message).__name__)}' can't come after 'hello'")
        else:
            if message.version != PROTOCOL_VERSION:
                raise _wrong_version(message.version)
            if isinstance(message, link.Hello):
                self._challenge(message)
            elif isinstance(message, link.Enroll):
                self._run(self._enroll(message))
            else:
                self._join(message)

    def sample(self, frame: SampleFrame) -> None:
        """Nothing but JSON before the proof."""
        raise MalformedMessage("a sample came before the robot proved itself")

    def lost(self, reason: str) -> None:
        """Nothing was opened."""

    def _run(self, work: Coroutine[Deferred[Any], Any, None]) -> None:
        self._connection.wait_for(Deferred.fromCoroutine(work))

    def _challenge(self, hello: link.Hello) -> None:
        # Unknown robots are challenged like known ones: who is enrolled here is nobody's business.
        self._hello = hello
        self._nonce = secrets.token_bytes(identity.NONCE_BYTES)
        self._connection.send(link.Challenge(nonce=link.to_base64(self._nonce), relay=self._hall.relay))

    async def _prove(self, hello: link.Hello, proof: link.Prove) -> None:
        hall, connection = self._hall, self._connection
        signature = link.from_base64(proof.signature, "the signature")
        # By robot and key: strangers in its network who only know its name can't lock the robot itself out.
        claimed = f"{hello.robot}#{hello.key}"
        if self._over_limit(claimed):
            return
        with self._counted(claimed, "robot.refused"):
            record = await _key_of(hall, hello)
            if record is None or not identity.verify(
                record.public_key, hall.relay, hello.robot, self._nonce, signature
            ):
                raise Refused(
                    "this key is not accepted for this robot; enroll the robot again if it should be"
                )
        robot = hall.registry.presence(record.robot_id, record.robot, record.realm)
        await hall.desks.coming(robot)
        if connection.ended:
            # It left while the database was asked; a registration now would be a ghost.
            return
        ControlRole(hall, connection, robot, hello).begin()
        # A key that was revoked since it was read: whoever looked for robots to cut may have missed this one.
        again = await _key_of(hall, hello)
        if again is None or again.robot_id != record.robot_id:
            connection.close("the robot's key is not accepted any more")

    async def _enroll(self, message: link.Enroll) -> None:
        hall, connection = self._hall, self._connection
        identity.check_robot_name(parted(message.robot)[0])
        public_key = link.from_base64(message.public_key, "the public key")
        if len(public_key) != identity.PUBLIC_KEY_BYTES:
            raise Invalid(f"an Ed25519 public key has {identity.PUBLIC_KEY_BYTES} bytes")
        if self._over_limit(message.robot):
            return
        with self._counted(message.robot, "robot.enrolment_refused"):
            await hall.store.write(_redeem, message, public_key, connection.address, hall.wall())
        connection.send(link.Enrolled(robot=message.robot, relay=hall.relay))
        connection.finish("enrolled")

    def _over_limit(self, claimed: str) -> bool:
        """Whether this robot has failed too often from here; judged before the database is asked."""
        wait = self._hall.failures.wait(claimed, self._connection.address)
        if wait > 0:
            self._connection.refuse(
                link.Refused(
                    reason=f"too many failures of this robot from your network; try again in {int(wait) + 1} s",
                    retry_after=wait,
                )
            )
        return wait > 0

    @contextmanager
    def _counted(self, claimed: str, refused: str) -> Iterator[None]:
        """A try that may fail: counted before it begins, so that many at once are no way around the limit.

        :param refused: kind of the event that tells of a refusal
        """
        hall, address = self._hall, self._connection.address
        hall.failures.failed(claimed, address)
        try:
            yield
        except Refused:
            hall.journal.event(refused, "relay", cause=address, claimed=claimed[:CLAIMED], address=address)
            raise
        except Unavailable:
            # Nothing was tried.
            hall.failures.forgive(claimed, address)
            raise
        hall.failures.succeeded(claimed, address)

    def _join(self, message: link.Join) -> None:
        connection = self._connection
        stream = self._hall.videos.redeem(message.ticket)
        if stream is not None:
            self._joined(stream.name, VideoRole(stream, connection, self._hall.seconds), limits.PICTURE_FRAME)
            stream.joined(connection)
            return
        try:
            channel = self._hall.channels.redeem(message.ticket)
        except Refused as error:
            connection.refuse(link.Refused(reason=str(error), code=error.code))
            return
        end = ChannelRole(channel, connection)
        self._joined(channel.name, end, limits.ROBOT_FRAME, connection.timing.largest_sample)
        connection.pace(parts=message.parts)
        channel.joined(connection)

    def _joined(self, name: str, end: LinkRole, frame_limit: int, sample_limit: int = 0) -> None:
        self._connection.send(link.Joined(channel=name, at=self._connection.clock_ns()))
        self._connection.proven(end, frame_limit, sample_limit=sample_limit)


async def _key_of(hall: RobotLinkContext, hello: link.Hello) -> queries.RobotKeyRecord | None:
    """The key that a robot says it has, if it is live."""
    name, realm = parted(hello.robot)
    return await hall.store.read(queries.robot_key, name, hello.key, realm)


def _redeem(s: Session, message: link.Enroll, public_key: bytes, origin: str, now: float) -> RobotRecord:
    """Enroll the robot and put that on record, both or neither."""
    fingerprint = identity.fingerprint(public_key)
    code = passwords.code_hash(message.code)
    name, realm = parted(message.robot)
    record = queries.redeem_enrolment_code(
        s, name, code, public_key, fingerprint, message.agent[:200], now, realm
    )
    queries.append_audit(
        s,
        at=now,
        actor=f"robot:{record.full}",
        action="robot.enrolled",
        target=record.full,
        origin=origin,
        data={"key": fingerprint},
    )
    return record


def _wrong_version(version: int) -> MalformedMessage:
    """What a robot of another protocol version is told."""
    return MalformedMessage(
        f"this relay speaks version {PROTOCOL_VERSION} of the robot link, the robot {version}; update the older one"
    )


class ControlRole(LinkRole):
    """The control link of a registered robot."""

    log = Logger()

    def __init__(
        self, hall: RobotLinkContext, connection: RobotConnection, robot: RobotState, hello: link.Hello
    ) -> None:
        self._hall = hall
        self._connection = connection
        self._robot = robot
        self._hello = hello

    def begin(self) -> None:
        """Register the robot, unless it has only just registered from elsewhere."""
        robot, hall, connection = self._robot, self._hall, self._connection
        used_twice = partial(self._used_twice, connection.address, robot.address)
        now = hall.seconds()
        wait = robot.registered_at + robot.patience - now
        if robot.control is not None and wait > 0:
            connection.refuse(
                link.Refused(
                    reason="this robot registered a moment ago on another connection; is its key used twice?",
                    retry_after=wait,
                )
            )
            robot.control.round_trip().addCallbacks(lambda _: used_twice(), lambda _: None)
            return
        self._replace(now - robot.registered_at)
        session = secrets.token_hex(4)
        connection.send(
            link.Welcome(
                session=session,
                heartbeat=connection.timing.heartbeat,
                frame_limit=limits.ROBOT_FRAME,
                sample_limit=connection.timing.largest_sample,
            )
        )
        robot.registered_at = now
        robot.session = session
        robot.key = self._hello.key
        robot.encodings = tuple(self._hello.encodings)
        robot.address = connection.address
        connection.on_round_trip = self._round_trip
        connection.proven(self, limits.CONTROL_FRAME, measured=True)
        hall.registry.registered(robot, connection, used_twice)
        self._event("robot.online", address=connection.address)
        self.log.info(
            "robot {robot} is online from {address} ({agent})",
            robot=robot.full,
            address=connection.address,
            agent=self._hello.agent[:100],
        )

    def _replace(self, age: float) -> None:
        """Take the place of a registration of this age, seconds, if there is one."""
        robot = self._robot
        if robot.control is None or age >= FLAPPING_SECONDS:
            robot.patience = REPLACE_SECONDS
            return
        robot.patience = min(MOST_PATIENCE, robot.patience * 2)

    def _used_twice(self, newer: str, older: str) -> None:
        """A daemon answers on a link although another one has proved the same key since: one has no two links."""
        self.log.warn(
            "the key of robot {robot} is used by two daemons, at {older} and {newer}",
            robot=self._robot.full,
            older=older,
            newer=newer,
            limited="key used twice",
        )
        self._event("robot.key_used_twice", addresses=f"{older}, {newer}")

    def _event(self, kind: str, source: str = "relay", what: str = "robot", **data: Any) -> bool:
        robot = self._robot
        return self._hall.journal.event(
            kind, source, cause=f"{what}:{robot.realm}/{robot.name}", robot_id=robot.robot_id, **data
        )

    def message(self, body: bytes) -> None:
        """What the robot tells of itself."""
        self._hall.registry.seen(self._robot)
        message = jsontext.decode(link.robot_control_decoder, body)
        if isinstance(message, link.Graph):
            self._hall.registry.graph(self._robot, message)
        elif isinstance(message, link.Health):
            self._robot.health = message
            self._hall.registry.changed()
        elif isinstance(message, link.Describe):
            self._hall.registry.described(self._robot, message)
        elif isinstance(message, link.Cameras):
            self._hall.registry.cameras(self._robot, message)
        elif isinstance(message, (link.Safety, link.Done)):
            self._hall.desks.of(self._robot).told(message)
        elif isinstance(message, link.Alert):
            self._alert(message)
        elif isinstance(message, link.AlertsTold):
            self._hall.journal.tell("robot.alerts_told", self._robot.robot_id)
        elif isinstance(message, (link.Ping, link.Pong)):
            self._connection.heartbeat(message)
        elif isinstance(message, link.Bye):
            self._connection.close("bye")

    def _alert(self, alert: link.Alert) -> None:
        level, text = alert.level[:20], alert.text[:500]
        of = {"alert_kind": alert.kind, "about": alert.about, "over": alert.over}
        # A cause of its own: however much a robot says, that it comes and goes is kept.
        source = f"robot:{self._robot.name}"
        kept = self._event("robot.alert", source, "robot's words", level=level, text=text, **of)
        if kept and not alert.over:
            self.log.warn(
                "robot {robot}: {severity}: {text}", robot=self._robot.full, severity=level, text=text
            )

    def sample(self, frame: SampleFrame) -> None:
        """The control link never carries bulk data."""
        raise MalformedMessage("samples go over the channel link, not the control link")

    def lost(self, reason: str) -> None:
        """The robot is gone."""
        robot = self._robot
        was_ours = robot.control is self._connection
        self._hall.registry.lost(robot, self._connection)
        if was_ours:
            self.log.info("robot {robot} is offline: {reason}", robot=robot.full, reason=reason)
            self._event("robot.offline", reason=reason[:200])

    def _round_trip(self, seconds: float) -> None:
        self._robot.rtt = seconds
        self._hall.registry.seen(self._robot)


MOST_QUOTES = 256
"""Quotation marks of a message whose bulk is base64: more than all its fields have."""


class ChannelRole(LinkRole):
    """The robot's end of a channel."""

    def __init__(self, channel: Channel, connection: RobotConnection) -> None:
        self._channel = channel
        self._connection = connection

    def message(self, body: bytes) -> None:
        """An answer, or a definition."""
        if len(body) > limits.JSON_BODY and (
            body.count(b"{") + body.count(b"[") > 1 or body.count(b'"') > MOST_QUOTES
        ):
            raise MalformedMessage(
                f"JSON of more than {limits.JSON_BODY} bytes is taken only with its bulk as base64 in 'cdr'"
            )
        message = jsontext.decode(link.robot_channel_decoder, body)
        if isinstance(message, (link.Ping, link.Pong)):
            self._connection.heartbeat(message)
        elif isinstance(message, link.Bye):
            self._connection.close("bye")
        else:
            self._channel.message(message)

    def sample(self, frame: SampleFrame) -> None:
        """A sample of a subscribed topic."""
        self._channel.sample(frame.number, frame.body, frame.stamp)

    def lost(self, reason: str) -> None:
        """The link has ended."""
        self._channel.link_lost(self._connection)


LEAST_PART = KIB
"""Bytes of a part of a picture, at least, but of the last and now and then of the first: each is answered."""

QUESTIONS_A_SECOND = 1.0
QUESTIONS_AT_ONCE = 8
"""First parts that may be smaller: a robot measures the round trip by one, every few seconds."""


class VideoRole(LinkRole):
    """The robot's end of a stream.

    :param seconds: a monotonic clock
    """

    def __init__(
        self, stream: CameraStream, connection: RobotConnection, seconds: Callable[[], float]
    ) -> None:
        self._stream = stream
        self._questions = TokenBucket(QUESTIONS_A_SECOND, QUESTIONS_AT_ONCE, seconds)
        self._connection = connection
        self._parts = PictureJoiner(limits.PICTURE_FRAME - SAMPLE_HEAD)

    def message(self, body: bytes) -> None:
        """What it plays, or that it does not."""
        if len(body) > limits.JSON_BODY:
            raise MalformedMessage(f"JSON of more than {limits.JSON_BODY} bytes is not taken on a video link")
        message = jsontext.decode(link.robot_video_decoder, body)
        if isinstance(message, (link.Ping, link.Pong)):
            self._connection.heartbeat(message)
        elif isinstance(message, link.Bye):
            self._connection.close("bye")
        else:
            self._stream.message(message)

    def sample(self, frame: SampleFrame) -> None:
        """Topics have links of their own."""
        raise MalformedMessage("samples go over the channel link, not the link of a stream")

    def picture(self, frame: VideoFrame | PicturePart) -> None:
        """A picture of the stream, or a part of one, which is answered too."""
        if isinstance(frame, VideoFrame):
            self._parts.drop()
            self._stream.picture(frame)
            return
        last = frame.offset + len(frame.body) >= frame.total
        if len(frame.body) < LEAST_PART and not last and (frame.offset or not self._questions.take()):
            raise MalformedMessage(f"parts of a picture have at least {LEAST_PART} bytes, but for the last")
        whole = self._parts.join(frame)
        if whole is not None:
            self._stream.picture(whole)
        else:
            self._stream.part()
            self._connection.send(link.Took(number=frame.number, upto=self._parts.size))

    def lost(self, reason: str) -> None:
        """The link has ended."""
        self._stream.lost(self._connection)
