"""Handlers of a robot's connections, one for each purpose (SPEC 2): handshake, control link, channel link, link of a
camera stream, file link.

hello → challenge → prove → control link     enroll → enrolled → closed     join → channel, stream or files
"""

from __future__ import annotations

import random
import secrets
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import msgspec
from sqlalchemy.orm import Session
from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_db import queries
from relay_db.names import normalise
from relay_db.queries import RobotRecord
from relay_protocol import PROTOCOL_VERSION, identity, jsontext, limits, link
from relay_protocol.errors import Invalid, MalformedMessage, Refused, SwitchboardError, Unavailable
from relay_protocol.frames import SAMPLE_HEAD, SampleFrame, VideoFrame, VideoFrameJoiner, VideoFramePart
from relay_protocol.function_link import FUNCTION_FRAME
from relay_protocol.limits import KIB
from relay_protocol.realms import split_name
from relay_server.auth import login_limiter, passwords
from relay_server.auth.login_limiter import LoginLimiter
from relay_server.channels.channel import Channel, Channels
from relay_server.cluster.drain import DRAINING, RETRY_SECONDS
from relay_server.cluster.homes import RobotHomes
from relay_server.common.database import AsyncDatabase
from relay_server.common.token_bucket import TokenBucket
from relay_server.control.controllers import Controllers
from relay_server.events.bus import EventBus
from relay_server.files.file_link import FileLinkHandler
from relay_server.files.links import FileLinks
from relay_server.modules.robot_modules import ModuleRegistry
from relay_server.robots.connection import ON_EVERY_LINK, LinkHandler, RobotConnection
from relay_server.robots.registry import REPLACE_SECONDS, RobotRegistry, RobotState
from relay_server.video.stream import CameraStream
from relay_server.video.streams import CameraStreams

_log = Logger()

LONGEST_REPLACE_SECONDS = 60.0
FLAPPING_SECONDS = 2 * LONGEST_REPLACE_SECONDS
"""Replacing a registration younger than this doubles the time until it may be replaced again, up to
:data:`LONGEST_REPLACE_SECONDS`. Otherwise two daemons with one key would replace each other for ever."""

CLAIMED = 2 * limits.ROBOT_NAME
"""Characters of the name that a refused robot gave, in the event about it."""

LOGGED_ALERTS_A_SECOND = 1.0
LOGGED_ALERTS_AT_ONCE = 20
"""Alerts of one connection that are logged: so many a second in the long run, and at once."""

MOST_PROVING = 32
"""Robots whose proof is checked at a time. Further ones are to come again: when thousands dial at once, those that are
let in are registered soon, and the links of those that are registered stay alive."""

BUSY = "this relay lets many robots in at the moment"
BUSY_SECONDS = (2.0, 10.0)
"""Least and most seconds after which a robot that got this refusal comes again."""

FAILURES_OF_NETWORK = 1000
"""Failed proofs and enrolments allowed per network: many robots may dial from one address."""


FunctionLinkHandlers = Callable[[RobotConnection, queries.RobotKeyRecord, str], LinkHandler]
"""Makes the handler of a function link, of the connection, the robot and the fingerprint of its key."""


@dataclass(frozen=True)
class RobotLinkContext:
    """Services that the handlers of robot connections share.

    :param relay: the relay's name, part of what robots sign
    :param draining: whether robots are to dial another relay
    :param seconds: a monotonic clock
    :param wall: Unix time in seconds
    """

    relay: str
    database: AsyncDatabase
    robots: RobotRegistry
    channels: Channels
    cameras: CameraStreams
    controllers: Controllers
    modules: ModuleRegistry
    files: FileLinks
    functions: FunctionLinkHandlers
    homes: RobotHomes
    bus: EventBus
    seconds: Callable[[], float]
    wall: Callable[[], float]
    draining: Callable[[], bool] = lambda: False
    failures: LoginLimiter = field(init=False)
    proving: set[RobotConnection] = field(default_factory=set)
    """Connections whose proof is being checked."""

    def __post_init__(self) -> None:
        failures = LoginLimiter(self.seconds, FAILURES_OF_NETWORK, login_limiter.digest)
        object.__setattr__(self, "failures", failures)


class HandshakeHandler(LinkHandler):
    """A connection that has not proved its identity yet."""

    def __init__(self, context: RobotLinkContext, connection: RobotConnection) -> None:
        self._context = context
        self._connection = connection
        self._hello: link.Hello | None = None
        self._nonce = b""

    def message(self, body: bytes) -> None:
        """``hello``, ``enroll`` or ``join`` first; after ``hello``, ``prove``."""
        message = jsontext.decode(link.handshake_request_decoder, body)
        if isinstance(message, link.Prove):
            if self._hello is None:
                raise MalformedMessage("'prove' came before 'hello'")
            hello, self._hello = self._hello, None
            if len(self._context.proving) >= MOST_PROVING:
                wait = random.uniform(*BUSY_SECONDS)  # noqa: S311  # no secret
                self._connection.refuse(link.Refused(reason=BUSY, retry_after=wait))
            else:
                self._run(self._proving(hello, message))
        elif self._nonce:
            raise MalformedMessage(f"'{link.lower_tag(type(message).__name__)}' can't come after 'hello'")
        else:
            if message.version != PROTOCOL_VERSION:
                raise _wrong_version(message.version)
            if self._context.draining():
                self._connection.refuse(link.Refused(reason=DRAINING, retry_after=RETRY_SECONDS))
            elif isinstance(message, link.Hello):
                self._challenge(message)
            elif isinstance(message, link.Enroll):
                self._run(self._enroll(message))
            else:
                self._join(message)

    def sample(self, frame: SampleFrame) -> None:
        """Only JSON is accepted before the proof."""
        raise MalformedMessage("a sample came before the robot proved itself")

    def lost(self, reason: str) -> None:
        """Nothing was opened, so nothing is to be done."""

    def _run(self, work: Coroutine[Deferred[Any], Any, None]) -> None:
        self._connection.wait_for(Deferred.fromCoroutine(work))

    def _challenge(self, hello: link.Hello) -> None:
        # Unknown robots are challenged like known ones: which robots are enrolled is not disclosed.
        self._hello = hello
        self._nonce = secrets.token_bytes(identity.NONCE_BYTES)
        self._connection.send(link.Challenge(nonce=link.to_base64(self._nonce), relay=self._context.relay))

    async def _proving(self, hello: link.Hello, proof: link.Prove) -> None:
        self._context.proving.add(self._connection)
        try:
            await self._prove(hello, proof)
        finally:
            self._context.proving.discard(self._connection)

    async def _prove(self, hello: link.Hello, proof: link.Prove) -> None:
        context, connection = self._context, self._connection
        signature = link.from_base64(proof.signature, "the signature")
        # Counted by robot and key: a sender that knows only the name cannot lock the robot out.
        claimed = f"{hello.robot}#{hello.key}"
        if self._over_limit(claimed):
            return
        with self._counted(claimed, "robot.refused"):
            record = await _key_of(context, hello)
            if record is None or not identity.verify(
                record.public_key, context.relay, hello.robot, self._nonce, signature
            ):
                raise Refused(
                    "this key is not accepted for this robot; enroll the robot again if it should be"
                )
        if hello.functions:
            self._begin_functions(record, hello.key)
            return
        robot = context.robots.robot(record.robot_id, record.robot, record.realm)
        await context.homes.connecting(robot, connection.address, lambda: not connection.ended)
        # After that: a stop which another relay has stored before it knew of this one is found now, and one that it
        # stores later is announced.
        try:
            await context.controllers.robot_connecting(robot)
        except SwitchboardError:
            self._not_registered(robot)
            raise
        if connection.ended:
            # It closed while the database was asked. Registering it now would leave a robot without a link.
            self._not_registered(robot)
            return
        ControlLinkHandler(context, connection, robot, hello).begin()
        # The key may have been revoked since it was read, before this robot was there to be disconnected.
        again = await _key_of(context, hello)
        if again is None or again.robot_id != record.robot_id:
            connection.close("the robot's key is not accepted any more")

    def _not_registered(self, robot: RobotState) -> None:
        """This relay was recorded as the robot's home, and is not."""
        if robot.control_link is None:
            self._context.homes.disconnected(robot)

    def _begin_functions(self, record: queries.RobotKeyRecord, key: str) -> None:
        connection = self._connection
        if connection.ended:
            return
        heartbeat = connection.timing.heartbeat
        handler = self._context.functions(connection, record, key)
        connection.send(
            link.Welcome(session=secrets.token_hex(4), heartbeat=heartbeat, frame_limit=FUNCTION_FRAME)
        )
        connection.set_handler(handler, FUNCTION_FRAME)

    async def _enroll(self, message: link.Enroll) -> None:
        context, connection = self._context, self._connection
        identity.check_robot_name(split_name(message.robot)[0])
        public_key = link.from_base64(message.public_key, "the public key")
        if len(public_key) != identity.PUBLIC_KEY_BYTES:
            raise Invalid(f"an Ed25519 public key has {identity.PUBLIC_KEY_BYTES} bytes")
        if self._over_limit(message.robot):
            return
        with self._counted(message.robot, "robot.enrolment_refused"):
            await context.database.write(_redeem, message, public_key, connection.address, context.wall())
        connection.send(link.Enrolled(robot=message.robot, relay=context.relay))
        connection.finish("enrolled")

    def _over_limit(self, claimed: str) -> bool:
        """Whether this robot has failed too often from this network. Checked before the database is asked."""
        wait = self._context.failures.wait(claimed, self._connection.address)
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
        """Count an attempt before it begins, so that parallel attempts can't exceed the limit.

        :param refused: kind of the event that records a refusal
        """
        context, address = self._context, self._connection.address
        context.failures.failed(claimed, address)
        try:
            yield
        except Refused:
            realm = normalise(split_name(claimed.partition("#")[0])[1])
            context.bus.publish(refused, realm=realm, claimed=claimed[:CLAIMED], address=address)
            raise
        except Unavailable:
            # The key or code was not checked.
            context.failures.forgive(claimed, address)
            raise
        context.failures.succeeded(claimed, address)

    def _join(self, message: link.Join) -> None:
        connection = self._connection
        stream = self._context.cameras.redeem(message.ticket)
        if stream is not None:
            self._joined(
                stream.name, VideoLinkHandler(stream, connection, self._context.seconds), limits.VIDEO_FRAME
            )
            stream.joined(connection)
            return
        robot = self._context.files.redeem(message.ticket, connection)
        if robot is not None:
            self._joined(
                "files", FileLinkHandler(self._context.files.uploads, robot, connection), 2 * limits.FILE_PART
            )
            return
        try:
            channel = self._context.channels.redeem(message.ticket)
        except Refused as error:
            connection.refuse(link.Refused(reason=str(error), code=error.code))
            return
        handler = ChannelLinkHandler(channel, connection)
        self._joined(channel.name, handler, limits.ROBOT_FRAME, connection.timing.largest_sample)
        connection.pace(parts=message.parts)
        connection.report_drops(channel.publications.message_dropped)
        channel.joined(connection)

    def _joined(self, name: str, handler: LinkHandler, frame_limit: int, sample_limit: int = 0) -> None:
        self._connection.send(link.Joined(channel=name, at=self._connection.clock_ns()))
        self._connection.set_handler(handler, frame_limit, sample_limit=sample_limit)


async def _key_of(context: RobotLinkContext, hello: link.Hello) -> queries.RobotKeyRecord | None:
    """The key that the robot claims to have, if it is valid."""
    name, realm = split_name(hello.robot)
    return await context.database.read(queries.robot_key, name, hello.key, realm)


def _redeem(s: Session, message: link.Enroll, public_key: bytes, origin: str, now: float) -> RobotRecord:
    """Enroll the robot and write the audit entry, in one transaction."""
    fingerprint = identity.fingerprint(public_key)
    code = passwords.code_hash(message.code)
    name, realm = split_name(message.robot)
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
    return MalformedMessage(
        f"this relay speaks version {PROTOCOL_VERSION} of the robot link, the robot {version}; update the older one"
    )


def report_key_used_twice(bus: EventBus, robot: RobotState, newer: str, older: str) -> None:
    """The older link still answers after the same key was proved on another: two daemons use the key.

    :param newer: network address of the newer link
    :param older: that of the older one
    """
    _log.warn(
        "the key of robot {robot} is used by two daemons, at {older} and {newer}",
        robot=robot.full,
        older=older,
        newer=newer,
        limited="key used twice",
    )
    bus.publish("robot.key_used_twice", robot.robot_id, addresses=f"{older}, {newer}")


class ControlLinkHandler(LinkHandler):
    """The control link of a registered robot."""

    log = Logger()

    def __init__(
        self, context: RobotLinkContext, connection: RobotConnection, robot: RobotState, hello: link.Hello
    ) -> None:
        self._context = context
        self._connection = connection
        self._robot = robot
        self._hello = hello
        self._logged_alerts = TokenBucket(LOGGED_ALERTS_A_SECOND, LOGGED_ALERTS_AT_ONCE, context.seconds)

    def begin(self) -> None:
        """Register the robot, unless it has only just registered from elsewhere."""
        robot, context, connection = self._robot, self._context, self._connection
        used_twice = partial(report_key_used_twice, context.bus, robot, connection.address, robot.address)
        now = context.seconds()
        wait = robot.registered_at + robot.replace_after - now
        if robot.control_link is not None and wait > 0:
            connection.refuse(
                link.Refused(
                    reason="this robot registered a moment ago on another connection; is its key used twice?",
                    retry_after=wait,
                )
            )
            robot.control_link.round_trip().addCallbacks(lambda _: used_twice(), lambda _: None)
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
        connection.set_handler(self, limits.CONTROL_FRAME, measured=True)
        context.robots.registered(robot, connection, used_twice)
        self._publish("robot.online", address=connection.address)
        self.log.info(
            "robot {robot} is online from {address} ({agent})",
            robot=robot.full,
            address=connection.address,
            agent=self._hello.agent[:100],
        )

    def _replace(self, age: float) -> None:
        """Replace a registration of this age, in seconds, if there is one."""
        robot = self._robot
        if robot.control_link is None or age >= FLAPPING_SECONDS:
            robot.replace_after = REPLACE_SECONDS
            return
        robot.replace_after = min(LONGEST_REPLACE_SECONDS, robot.replace_after * 2)

    def _publish(self, kind: str, **data: Any) -> None:
        self._context.bus.publish(kind, self._robot.robot_id, **data)

    def _take_health(self, health: link.Health) -> None:
        charge = health.battery
        possible = charge is None or 0 <= charge <= 1
        self._robot.impossible_charge = None if possible else charge
        self._robot.health = health if possible else msgspec.structs.replace(health, battery=None)

    def message(self, body: bytes) -> None:
        """The robot sends its state."""
        self._context.robots.seen(self._robot)
        message = jsontext.decode(link.robot_control_decoder, body)
        if isinstance(message, link.Graph):
            self._context.robots.graph(self._robot, message)
        elif isinstance(message, link.Health):
            self._take_health(message)
            self._context.robots.changed()
        elif isinstance(message, link.DeviceReport):
            self._robot.device = message
        elif isinstance(message, link.Describe):
            self._context.robots.described(self._robot, message)
        elif isinstance(message, link.Cameras):
            self._context.robots.cameras(self._robot, message)
        elif isinstance(message, (link.MotionState, link.OrderResult)):
            self._context.controllers.of(self._robot).message_received(message)
        elif isinstance(message, (link.Modules, link.ModuleOrdered, link.ModuleLog, link.Processes)):
            self._context.modules.of(self._robot).message_received(message)
        elif isinstance(message, link.RequestFileLink):
            self._context.files.request(self._robot)
        elif isinstance(message, link.Alert):
            self._alert(message)
        elif isinstance(message, link.ActiveAlertsSent):
            self._publish("robot.active_alerts_sent")
        elif isinstance(message, ON_EVERY_LINK):
            self._connection.common_message(message)

    def _alert(self, alert: link.Alert) -> None:
        level, text = alert.level[:20], alert.text[:500]
        of = {"alert_kind": alert.kind, "about": alert.about, "over": alert.over}
        self._publish("robot.alert", source=f"robot:{self._robot.name}", level=level, text=text, **of)
        if not alert.over and self._logged_alerts.take():
            self.log.warn(
                "robot {robot}: {severity}: {text}", robot=self._robot.full, severity=level, text=text
            )

    def sample(self, frame: SampleFrame) -> None:
        """The control link never carries bulk data."""
        raise MalformedMessage("samples go over the channel link, not the control link")

    def lost(self, reason: str) -> None:
        """The robot is offline."""
        robot = self._robot
        was_ours = robot.control_link is self._connection
        self._context.robots.lost(robot, self._connection)
        if was_ours:
            self._context.files.close(robot, "the robot's control link is lost")
            self._context.homes.disconnected(robot)
            self.log.info("robot {robot} is offline: {reason}", robot=robot.full, reason=reason)
            self._publish("robot.offline", reason=reason[:200])

    def _round_trip(self, seconds: float) -> None:
        self._robot.rtt = seconds
        self._context.robots.seen(self._robot)


MOST_QUOTES = 256
"""Quotation marks of a message whose bulk is base64: more than all its fields have."""


class ChannelLinkHandler(LinkHandler):
    """The relay's end of a channel's link: passes messages and samples to the channel."""

    def __init__(self, channel: Channel, connection: RobotConnection) -> None:
        self._channel = channel
        self._connection = connection

    def message(self, body: bytes) -> None:
        """An answer or a type definition."""
        if len(body) > limits.JSON_BODY and (
            body.count(b"{") + body.count(b"[") > 1 or body.count(b'"') > MOST_QUOTES
        ):
            raise MalformedMessage(
                f"JSON of more than {limits.JSON_BODY} bytes is accepted only with its bulk as base64 in 'cdr'"
            )
        message = jsontext.decode(link.robot_channel_decoder, body)
        if isinstance(message, ON_EVERY_LINK):
            self._connection.common_message(message)
        else:
            self._channel.message(message)

    def sample(self, frame: SampleFrame) -> None:
        """A sample of a subscribed topic."""
        self._channel.sample(frame.number, frame.body, frame.stamp)

    def lost(self, reason: str) -> None:
        """The link has ended."""
        self._channel.link_lost(self._connection)


LEAST_PART = KIB
"""Fewest bytes of a part of a frame, except the last and sometimes the first: each part is acknowledged."""

SMALL_PARTS_PER_SECOND = 1.0
SMALL_PARTS_BURST = 8
"""First parts that may be smaller: robots use one to measure the round trip every few seconds."""


class VideoLinkHandler(LinkHandler):
    """The relay's end of the link of a camera's stream.

    :param seconds: a monotonic clock
    """

    def __init__(
        self, stream: CameraStream, connection: RobotConnection, seconds: Callable[[], float]
    ) -> None:
        self._stream = stream
        self._small_parts = TokenBucket(SMALL_PARTS_PER_SECOND, SMALL_PARTS_BURST, seconds)
        self._connection = connection
        self._parts = VideoFrameJoiner(limits.VIDEO_FRAME - SAMPLE_HEAD)

    def message(self, body: bytes) -> None:
        """The state of the stream."""
        if len(body) > limits.JSON_BODY:
            raise MalformedMessage(f"JSON of more than {limits.JSON_BODY} bytes is not taken on a video link")
        message = jsontext.decode(link.robot_video_decoder, body)
        if isinstance(message, ON_EVERY_LINK):
            self._connection.common_message(message)
        else:
            self._stream.message_received(message)

    def sample(self, frame: SampleFrame) -> None:
        """Samples go over the channel link."""
        raise MalformedMessage("samples go over the channel link, not the link of a stream")

    def video_frame(self, frame: VideoFrame | VideoFramePart) -> None:
        """A frame of the stream, or a part of one, which is acknowledged."""
        if isinstance(frame, VideoFrame):
            self._parts.drop()
            self._stream.frame_received(frame)
            return
        last = frame.offset + len(frame.body) >= frame.total
        if len(frame.body) < LEAST_PART and not last and (frame.offset or not self._small_parts.take()):
            raise MalformedMessage(f"a part of a frame has at least {LEAST_PART} bytes, except the last")
        whole = self._parts.join(frame)
        if whole is not None:
            self._stream.frame_received(whole)
        else:
            self._stream.frame_part_received()
            self._connection.send(link.FrameAck(number=frame.number, received=self._parts.size))

    def lost(self, reason: str) -> None:
        """The link has ended."""
        self._parts.drop()
        self._stream.lost(self._connection)
