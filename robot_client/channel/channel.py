"""A channel on its connection."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.errors import SwitchboardError
from relay_protocol.frames import CommandFrame, SampleFrame
from robot_client.channel.action_goals import ChannelGoals, refusal
from robot_client.channel.advertisements import OfferedActions, OfferedServices
from robot_client.channel.parts import ChannelWriter, check_room
from robot_client.channel.service_calls import ChannelServiceCalls
from robot_client.channel.uplink import TOO_LARGE, WriteScheduler
from robot_client.link.clock_offset import ClockOffset
from robot_client.link.protocol import (
    CommandReceived,
    Event,
    JoinedChannel,
    LinkEnded,
    MessageReceived,
    SampleReceived,
)
from robot_client.link.transport import LinkLost, LinkProtocol
from robot_client.motion.active_goals import ActiveGoals
from robot_client.motion.authority import NOBODY
from robot_client.motion.gate import MotionGate
from robot_client.motion.goal_topics import GoalMessage, GoalTopics
from robot_client.motion.motion import MOTION_QOS, MotionControl
from robot_client.motion.typed_topic import TypedTopic
from robot_client.periodic import run_safely
from robot_client.platforms.base import OnChange, Platform, PublisherHandle, SubscriptionHandle
from robot_client.twisted_types import ReactorClock


class _RobotSubscription:
    """A subscription of the relay's.

    :param topic: its full name
    """

    source: SubscriptionHandle

    def __init__(self, sending: WriteScheduler, request: link.Subscribe, topic: str) -> None:
        self._sending = sending
        self.request = request
        self.topic = topic
        self.too_large = False
        """Whether the log has been told that a sample was too large."""

    def take(self, body: bytes) -> None:
        """Pass a sample on."""
        self._sending.offer(self.request.number, body, self.source.stamp)

    def recall(self, known: frozenset[int]) -> None:
        """Repeat what publishers keep.

        :param known: stamps of the samples whose bodies the relay has
        """
        number, repeat = self.request.number, self._sending.repeat
        self.source.recall(
            lambda stamp, body: repeat(number, stamp, b"" if stamp in known else body),
            lambda: repeat(number, 0, b""),
        )


class _RobotPublication(NamedTuple):
    sink: PublisherHandle
    topic: str
    motion: str | None
    """Name of the publication at the motion desk, if it moves the robot."""
    goal: str | None = None
    """Name of the publication at the goal topics, if it takes goals."""

    @property
    def moves(self) -> bool:
        """Whether it takes commands alone."""
        return self.motion is not None or self.goal is not None


class RobotChannel:
    """The robot's end of one channel.

    :param name: the relay's name for it
    :param offset: clock offset of this very link
    :param gate: judges calls and goals that move the robot
    :param silent: topics that say nothing now, and whether they say their last value instead
    :param goal_topics: judges what is published where one message sends the robot off
    :param pursuits: sees that goals that move the robot end with the daemon
    :param sample_limit: largest sample that may go in parts, bytes; 0 for what fits into a frame
    """

    def __init__(
        self,
        name: str,
        wire: ChannelWriter,
        offset: ClockOffset,
        platform: Platform,
        motion: MotionControl,
        clock: ReactorClock,
        frame_limit: int,
        gate: MotionGate,
        silent: Mapping[str, bool],
        wall: Callable[[], int] = time.time_ns,
        goal_topics: GoalTopics | None = None,
        pursuits: ActiveGoals | None = None,
        sample_limit: int = 0,
    ) -> None:
        self.name = name
        self._goal_topics = goal_topics
        self._gate = gate
        self._silent = silent
        self._wire = wire
        self._offset = offset
        self._platform = platform
        self._motion = motion
        self._sending = WriteScheduler(
            wire, clock, platform.after_samples, frame_limit, wall, sample_limit=sample_limit, lost=self._lost
        )
        self.uplink = self._sending.uplink
        self._listening: dict[int, _RobotSubscription] = {}
        self._publishing: dict[int, _RobotPublication] = {}
        self._calls = ChannelServiceCalls(wire, platform, frame_limit, gate, offset)
        self._goals = ChannelGoals(wire, platform, frame_limit, gate, offset, clock, pursuits)
        self._services = OfferedServices(wire, platform, frame_limit)
        self._actions = OfferedActions(wire, platform, frame_limit)
        self._log = Logger("channel")
        self._handlers: dict[type, Callable[[Any], None]] = {
            link.Subscribe: self._subscribe,
            link.Unsubscribe: lambda message: self._unlisten(message.number),
            link.Advertise: self._advertise,
            link.Unadvertise: lambda message: self._unpublish(message.number),
            link.CallService: self._calls.call,
            link.SendActionGoal: self._goals.begin,
            link.CancelActionGoal: self._goals.cancel,
            link.AdvertiseService: self._advertise_service,
            link.UnadvertiseService: self._services.withdraw,
            link.ServiceResponse: self._services.answer,
            link.AdvertiseAction: self._actions.advertise,
            link.UnadvertiseAction: self._actions.withdraw,
            link.ActionFeedback: self._actions.feedback,
            link.ActionResult: self._actions.result,
            link.GetType: self._get_type,
            link.GetInterfaces: self._get_interfaces,
        }

    # --- from the relay ------------------------------------------------------------------------------------

    def handle(self, message: link.Message) -> None:
        """Do what one message asks; what can't be done is answered in words."""
        try:
            self._handlers[type(message)](message)
        except SwitchboardError as error:
            self._fail(message, str(error))
        except Exception:
            # A middleware that throws something unforeseen must not cost the other users their channel.
            self._log.failure("a request on channel {channel} failed", channel=self.name)
            self._fail(message, "the robot could not do this; its log says why")

    def sample(self, frame: SampleFrame) -> None:
        """Publish one message, if it may still be published; what moves the robot takes commands alone."""
        publishing = self._publishing.get(frame.number)
        if publishing is not None and publishing.moves:
            self._motion.refuse()
        elif publishing is not None:
            self._publish(publishing, frame, NOBODY)

    def command(self, frame: CommandFrame) -> None:
        """Publish one command, if it may still be published."""
        publishing = self._publishing.get(frame.number)
        if publishing is not None:
            self._publish(publishing, frame, frame.source)

    def silence(self, topic: str) -> None:
        """A topic has begun to say nothing, or says something again."""
        for number, listening in self._listening.items():
            if listening.topic == topic:
                self._mute(number, topic)

    def cancel_goals(self, only_moving: bool) -> None:
        """The robot is to stop; see :meth:`robot_client.channel.action_goals.ChannelGoals.cancel_all`."""
        self._goals.cancel_all(only_moving)

    def _publish(self, publishing: _RobotPublication, frame: SampleFrame | CommandFrame, by: int) -> None:
        try:
            if publishing.motion is not None:
                self._motion.command(publishing.motion, frame.body, frame.stamp, self._offset, by)
            elif publishing.goal is not None and self._goal_topics is not None:
                goal = GoalMessage(frame.body, frame.stamp, self._offset, by)
                self._goal_topics.take(publishing.goal, goal)
            else:
                publishing.sink.publish(frame.body)
        except Exception as error:
            self._log.error("could not publish on {topic}: {error}", topic=publishing.topic, error=str(error))

    def close(self) -> None:
        """The link is gone: stop what moves, release all; what fails holds up nothing else."""
        failed = "something could not be released at the end of a channel"
        run_safely(self._log, failed, self._goals.close)
        for number in list(self._publishing):
            run_safely(self._log, failed, self._unpublish, number)
        for number in list(self._listening):
            run_safely(self._log, failed, self._unlisten, number)
        for part in (self._services, self._actions, self._calls, self._sending):
            run_safely(self._log, failed, part.close)

    def flush(self) -> None:
        """Write what waits, as far as the transport takes it."""
        self._sending.flush()

    def pause(self) -> None:
        """The transport is full."""
        self._goals.pause()
        self._sending.pause()

    def resume(self) -> None:
        """The transport has room again."""
        self._goals.resume()
        self._sending.resume()

    # --- requests ------------------------------------------------------------------------------------------

    def _subscribe(self, message: link.Subscribe) -> None:
        number = message.number
        known = self._listening.get(number)
        if known is not None:
            known.request = message
            self._confirm(number)
            self._sending.arm()
            if message.kept is not None and known.source.replays:
                self._recall(known, frozenset(message.kept))
            return
        check_room(self._listening, "subscriptions")
        topic = self._platform.full_name(message.topic, "topic")
        listening = _RobotSubscription(self._sending, message, topic)
        listening.source = self._platform.subscribe(
            message.topic, message.type, message.qos, listening.take, lambda: self._confirm(number)
        )
        self._listening[number] = listening
        self._confirm(number)
        if topic in self._silent:
            self._mute(number, topic)

    def _confirm(self, number: int) -> None:
        listening = self._listening.get(number)
        if listening is None:
            return
        source, request = listening.source, listening.request
        self.uplink.open(number, request.throttle_ms / 1000, source.latched)
        self._wire.say(
            link.Subscribed(
                number=number,
                topic=request.topic,
                type=source.type,
                encoding=self._platform.encoding,
                latched=source.latched,
                publishers=source.publishers,
                replays=source.replays,
                unmatched=source.unmatched,
            )
        )

    def _lost(self, loss: link.Lost) -> None:
        """Samples of a subscription were not sent."""
        self._wire.say(loss)
        listening = self._listening.get(loss.number)
        if listening is not None and loss.reason == TOO_LARGE and not listening.too_large:
            listening.too_large = True
            self._log.warn(
                "{topic}: a sample of {size} bytes is too large to be sent ([ros] largest_sample_mb here, "
                "--largest-sample-mb of the relay); it is not said again of this subscription",
                topic=listening.topic,
                size=loss.size,
            )

    def _recall(self, listening: _RobotSubscription, known: frozenset[int]) -> None:
        try:
            listening.recall(known)
        except Exception:
            # The subscription itself goes on.
            self._log.failure("could not ask for what publishers of {topic} keep", topic=listening.topic)
            self._sending.repeat(listening.request.number, 0, b"")

    def _mute(self, number: int, topic: str) -> None:
        hold = self._silent.get(topic)
        if hold is None:
            self._sending.unmute(number)
        else:
            self.uplink.mute(number, hold)

    def _unlisten(self, number: int) -> None:
        listening = self._listening.pop(number, None)
        if listening is not None:
            listening.source.close()
            self._sending.end(number)

    def _advertise(self, message: link.Advertise) -> None:
        number = message.number
        if number in self._publishing:
            self._unpublish(number)
        check_room(self._publishing, "publications")
        # What moves is judged by the names that are used in the end: the relay may spell them as it likes.
        on = self._platform.resolve(message.topic, message.type)
        confirm = partial(self._confirm_advertised, message, on.type)
        if self._motion.concerns(on):
            self._publishing[number] = self._advertise_motion(number, on, confirm)
            self._log.info("{who} may drive by {topic}", who=message.source or "a client", topic=on.topic)
        elif self._goal_topics is not None and self._goal_topics.concern(on):
            # Kept for late joiners, a goal would send the robot off again.
            sink = self._platform.advertise(*on, False, MOTION_QOS, on_change=confirm)
            name = f"{self.name}/{number}"
            self._goal_topics.open(name, on, sink)
            self._publishing[number] = _RobotPublication(sink, on.topic, None, name)
        else:
            sink = self._platform.advertise(*on, message.latch, message.qos, message.queue_size, confirm)
            self._publishing[number] = _RobotPublication(sink, on.topic, None)
        confirm()

    def _confirm_advertised(self, message: link.Advertise, type: str) -> None:
        publishing = self._publishing.get(message.number)
        if publishing is None:
            return
        self._wire.say(
            link.Advertised(
                number=message.number,
                topic=message.topic,
                type=type,
                encoding=self._platform.encoding,
                motion=publishing.moves,
                unmatched=publishing.sink.unmatched,
            )
        )

    def _advertise_motion(self, number: int, on: TypedTopic, confirm: OnChange) -> _RobotPublication:
        name = f"{self.name}/{number}"
        sink = self._platform.advertise(*on, False, MOTION_QOS, on_change=confirm)
        try:
            self._motion.open(name, on, sink)
        except SwitchboardError:
            sink.close()
            raise
        return _RobotPublication(sink, on.topic, name)

    def _advertise_service(self, message: link.AdvertiseService) -> None:
        self._gate.offer(message.service)
        self._services.advertise(message)

    def _unpublish(self, number: int) -> None:
        publishing = self._publishing.pop(number, None)
        if publishing is None:
            return
        if publishing.motion is not None:
            self._motion.close(publishing.motion)
        elif publishing.goal is not None and self._goal_topics is not None:
            self._goal_topics.close(publishing.goal)
        else:
            publishing.sink.close()

    def _get_type(self, message: link.GetType) -> None:
        self._wire.say(self._platform.definition(message.type))

    def _get_interfaces(self, message: link.GetInterfaces) -> None:
        self._wire.say(link.Interfaces(types=self._platform.interfaces()))

    def _fail(self, message: link.Message, reason: str) -> None:
        if isinstance(message, link.CallService):
            self._wire.say(link.ServiceResponse(id=message.id, result=False, reason=reason))
        elif isinstance(message, link.SendActionGoal):
            self._wire.say(refusal(message, reason))
        else:
            what = link.lower_tag(type(message).__name__)
            ref = getattr(message, _REFERENCE.get(type(message), "number"), "")
            self._wire.say(link.Failed(what=what, ref=str(ref), reason=reason))


_REFERENCE: dict[type, str] = {
    link.GetType: "type",
    link.AdvertiseService: "service",
    link.UnadvertiseService: "service",
    link.AdvertiseAction: "action",
    link.UnadvertiseAction: "action",
    link.CancelActionGoal: "id",
    link.ServiceResponse: "id",
    link.ActionFeedback: "id",
    link.ActionResult: "id",
}
"""What tells which request failed; of topics it is the number."""


class ChannelConnection(ChannelWriter):
    """Joins a channel to its connection."""

    def __init__(
        self, name: str, protocol: LinkProtocol, on_gone: Callable[[ChannelConnection, str], None]
    ) -> None:
        self.name = name
        self.protocol = protocol
        self.channel: RobotChannel
        self._on_gone = on_gone

    def say(self, message: link.Message) -> None:
        """Send a message."""
        self.protocol.link.say(message)
        self.protocol.flush()

    @property
    def room(self) -> int:
        """Bytes of sample frames that should be written now."""
        return self.protocol.room

    def write(self, frames: list[bytes]) -> None:
        """Send sample frames."""
        self.protocol.write(frames)

    def on_event(self, event: Event) -> None:
        """The relay said something."""
        if isinstance(event, SampleReceived):
            self.channel.sample(event.frame)
        elif isinstance(event, CommandReceived):
            self.channel.command(event.frame)
        elif isinstance(event, MessageReceived):
            self.channel.handle(event.message)
        elif isinstance(event, JoinedChannel) and event.channel != self.name:
            self.protocol.end(LinkLost(f"the relay joined us to '{event.channel}' instead of '{self.name}'"))
        elif isinstance(event, LinkEnded):
            self.protocol.end(LinkLost(f"the relay closed the channel: {event.reason}"), gently=True)

    def on_lost(self, reason: SwitchboardError) -> None:
        """The connection is gone."""
        self._on_gone(self, str(reason))

    def on_pause(self) -> None:
        """The transport is full."""
        self.channel.pause()

    def on_resume(self) -> None:
        """The transport has room."""
        self.channel.resume()
