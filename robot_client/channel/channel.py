"""One channel: subscribes and publishes for the relay; calls, goals, offers and assets have files of their own.

:meth:`RobotChannel.publish` is the path of a client's message into the robot, :meth:`_RelaySubscription.on_sample` that
of a sample out of it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.errors import SwitchboardError
from relay_protocol.frames import CommandFrame, SampleFrame
from robot_client.channel.action_goals import ChannelGoals, refusal
from robot_client.channel.assets import ChannelAssets
from robot_client.channel.clouds import TYPE as CLOUD
from robot_client.channel.clouds import CloudThinner
from robot_client.channel.handler import ChannelWriter, check_room
from robot_client.channel.offered_services import AdvertisedActions, AdvertisedServices
from robot_client.channel.sample_queue import TOO_LARGE, WriteScheduler
from robot_client.channel.service_calls import ChannelServiceCalls
from robot_client.link.clock_offset import ClockOffset
from robot_client.link.links import (
    CommandReceived,
    Event,
    JoinedChannel,
    LinkEnded,
    MessageReceived,
    SampleReceived,
)
from robot_client.link.transport import LinkLost, LinkProtocol
from robot_client.motion.active_goals import ActiveGoals
from robot_client.motion.goal_topics import GoalMessage, GoalTopics
from robot_client.motion.motion_control import MOTION_QOS, MotionControl
from robot_client.motion.request_gate import MotionRequestGate
from robot_client.motion.typed_topic import TypedTopic
from robot_client.periodic import run_safely
from robot_client.platforms.base import OnChange, Platform, PublisherHandle, SubscriptionHandle
from robot_client.twisted_types import ReactorClock

NOT_THINNED = "not_thinned"
"""Why a cloud was not sent: it is malformed, or has no coordinates."""

OnLoss = Callable[[link.SamplesDropped], None]


class _RelaySubscription:
    """A subscription that the relay requested.

    :param topic: full name
    """

    handle: SubscriptionHandle

    def __init__(self, scheduler: WriteScheduler, request: link.Subscribe, topic: str) -> None:
        self._scheduler = scheduler
        self.request = request
        self.topic = topic
        self.logged_too_large = False
        self._thinner: CloudThinner | None = None

    def on_sample(self, body: bytes) -> None:
        # Late joiners get clouds of latched topics as their publishers keep them, so those are not thinned.
        if self._thinner is not None and not self.handle.latched:
            self._thinner.put(body, self.handle.stamp)
        else:
            self._scheduler.enqueue(self.request.number, body, self.handle.stamp)

    def on_dropped(self, count: int) -> None:
        """Samples were dropped because the daemon, or the thread that thins them, was too slow."""
        self._scheduler.dropped_before(self.request.number, count)

    def update(self, request: link.Subscribe, encoding: str, on_loss: OnLoss) -> None:
        """Apply a request.

        :param encoding: of the samples; only CDR is thinned
        """
        self.request = request
        thinning = request.thin
        if thinning is None or not thinning.thins or self.handle.type != CLOUD or encoding != "cdr":
            self.close_thinner()
        elif self._thinner is not None:
            self._thinner.thinning = thinning
        else:
            self._thinner = CloudThinner(
                thinning, self._thinned, partial(self._refused, on_loss), lambda: self.on_dropped(1)
            )

    def close_thinner(self) -> None:
        """Samples are not thinned any more."""
        if self._thinner is not None:
            self._thinner.close()
            self._thinner = None

    def _thinned(self, body: bytes, stamp: int) -> None:
        self._scheduler.enqueue(self.request.number, body, stamp)
        self._scheduler.flush()

    def _refused(self, on_loss: OnLoss, size: int, why: str) -> None:
        on_loss(
            link.SamplesDropped(number=self.request.number, reason=NOT_THINNED, count=1, size=size, why=why)
        )

    def repeat_latched(self, known: frozenset[int]) -> None:
        """Send the latched samples of all publishers again.

        :param known: stamps of samples whose bodies the relay has
        """
        number, enqueue = self.request.number, self._scheduler.enqueue_latched
        self.handle.request_latched(
            lambda stamp, body: enqueue(number, stamp, b"" if stamp in known else body),
            lambda: enqueue(number, 0, b""),
        )


class _RelayPublication(NamedTuple):
    """A topic that the relay publishes to."""

    handle: PublisherHandle
    topic: str
    motion_id: str | None = None
    """Id of the publication in :class:`MotionControl` if it moves the robot."""
    goal_id: str | None = None
    """Id of the publication in :class:`GoalTopics` if its messages are goals."""

    @property
    def moves(self) -> bool:
        """Whether only command frames may be published on it."""
        return self.motion_id is not None or self.goal_id is not None


class RobotChannel:
    """The robot's end of one channel.

    :param offset: clock offset of this link
    :param gate: judges calls and goals that move the robot
    :param inhibited: inhibited topics, and whether their last value is held
    :param goal_topics: judges messages on topics where one message starts motion
    :param active_goals: ends goals that move the robot when the daemon ends
    :param wall: wall clock for stamps, nanoseconds since 1970
    :param sample_limit: largest sample that may be sent in parts, bytes; 0 if each must fit into a frame
    :param asset_roots: directories outside of packages to which links of their files may lead
    """

    def __init__(
        self,
        *,
        name: str,
        writer: ChannelWriter,
        offset: ClockOffset,
        platform: Platform,
        motion: MotionControl,
        clock: ReactorClock,
        frame_limit: int,
        gate: MotionRequestGate,
        inhibited: Mapping[str, bool],
        wall: Callable[[], int] = time.time_ns,
        goal_topics: GoalTopics | None = None,
        active_goals: ActiveGoals | None = None,
        sample_limit: int = 0,
        asset_roots: Iterable[Path] = (),
    ) -> None:
        self.name = name
        self._goal_topics = goal_topics
        self._gate = gate
        self._inhibited = inhibited
        self._writer = writer
        self._offset = offset
        self._platform = platform
        self._motion = motion
        self._scheduler = WriteScheduler(
            writer,
            clock,
            platform.after_samples,
            frame_limit,
            wall,
            sample_limit=sample_limit,
            on_loss=self._report_loss,
        )
        self.sample_queue = self._scheduler.queue
        self._subscriptions: dict[int, _RelaySubscription] = {}
        self._publications: dict[int, _RelayPublication] = {}
        self._calls = ChannelServiceCalls(writer, platform, frame_limit, gate, offset)
        self._goals = ChannelGoals(writer, platform, frame_limit, gate, offset, clock, active_goals)
        self._services = AdvertisedServices(writer, platform, frame_limit)
        self._actions = AdvertisedActions(writer, platform, frame_limit)
        self._assets = ChannelAssets(writer, roots=asset_roots)
        self._log = Logger("channel")
        self._handlers = self._message_handlers()

    def _message_handlers(self) -> dict[type, Callable[[Any], None]]:
        return {
            link.Subscribe: self._subscribe,
            link.Unsubscribe: lambda message: self._unsubscribe(message.number),
            link.Advertise: self._advertise,
            link.Unadvertise: lambda message: self._end_publication(message.number),
            link.CallService: self._calls.call,
            link.SendActionGoal: self._goals.send_goal,
            link.CancelActionGoal: self._goals.cancel,
            link.AdvertiseService: self._advertise_service,
            link.UnadvertiseService: self._services.withdraw,
            link.ServiceResponse: self._services.respond,
            link.AdvertiseAction: self._actions.advertise,
            link.UnadvertiseAction: self._actions.withdraw,
            link.ActionFeedback: self._actions.feedback,
            link.ActionResult: self._actions.result,
            link.GetType: self._get_type,
            link.GetInterfaces: self._get_interfaces,
            link.GetAsset: self._assets.get,
        }

    # --- from the relay ------------------------------------------------------------------------------------

    def handle(self, message: link.Message) -> None:
        """Carry out a request; a failure is answered with the reason."""
        try:
            self._handlers[type(message)](message)
        except SwitchboardError as error:
            self._fail(message, str(error))
        except Exception:
            # An unexpected error of the middleware must not close the channel, which other clients use too.
            self._log.failure("a request on channel {channel} failed", channel=self.name)
            self._fail(message, "the request failed on the robot; the robot's log says why")

    def publish(self, frame: SampleFrame | CommandFrame) -> None:
        """Publish a sample, or a command if motion control allows it.

        Publications that move the robot take command frames only, which name the connection that sent them.
        """
        publication = self._publications.get(frame.number)
        if publication is None:
            return
        try:
            if not publication.moves:
                publication.handle.publish(frame.body)
            elif isinstance(frame, SampleFrame):
                self._motion.refuse_sample()
            elif publication.motion_id is not None:
                self._motion.command(
                    publication.motion_id, frame.body, frame.stamp, self._offset, frame.source
                )
            elif publication.goal_id is not None and self._goal_topics is not None:
                goal = GoalMessage(frame.body, frame.stamp, self._offset, frame.source)
                self._goal_topics.publish(publication.goal_id, goal)
        except Exception as error:
            self._log.error(
                "could not publish on {topic}: {error}",
                topic=publication.topic,
                error=str(error),
                limited="publish",
            )

    def update_inhibition(self, topic: str) -> None:
        """Apply the beginning or end of a topic's inhibition."""
        for number, subscription in self._subscriptions.items():
            if subscription.topic == topic:
                self._apply_inhibition(number, topic)

    @property
    def is_busy(self) -> bool:
        """Whether calls or goals are under way, in either direction."""
        return any(each.is_busy for each in (self._calls, self._goals, self._services, self._actions))

    def cancel_goals(self, only_moving: bool) -> None:
        """See :meth:`robot_client.channel.action_goals.ChannelGoals.cancel_all`."""
        self._goals.cancel_all(only_moving)

    def close(self) -> None:
        """Stop motion and release everything; a failure does not prevent the following steps."""
        failed = "a step failed while a channel was closed"
        run_safely(self._log, failed, self._goals.close)
        for number in list(self._publications):
            run_safely(self._log, failed, self._unadvertise, number)
        if self._goal_topics is not None:
            run_safely(self._log, failed, self._goal_topics.close_ending, self._goal_id(""))
        for number in list(self._subscriptions):
            run_safely(self._log, failed, self._unsubscribe, number)
        for handler in (self._services, self._actions, self._calls, self._scheduler, self._assets):
            run_safely(self._log, failed, handler.close)

    def flush(self) -> None:
        """Write queued samples, as far as the transport has room."""
        self._scheduler.flush()

    def pause(self) -> None:
        """Hold samples and feedback, as the transport is full."""
        self._goals.pause()
        self._scheduler.pause()

    def resume(self) -> None:
        """Send again, as the transport has room."""
        self._goals.resume()
        self._scheduler.resume()

    # --- requests ------------------------------------------------------------------------------------------

    def _subscribe(self, message: link.Subscribe) -> None:
        number = message.number
        known = self._subscriptions.get(number)
        if known is not None:
            known.update(message, self._platform.encoding, self._report_loss)
            self._confirm(number)
            self._scheduler.set_throttle_timer()
            if message.known_stamps is not None and known.handle.stamps_id:
                self._repeat_latched(known, frozenset(message.known_stamps))
            return
        check_room(self._subscriptions, "subscriptions")
        topic = self._platform.full_name(message.topic, "topic")
        subscription = _RelaySubscription(self._scheduler, message, topic)
        subscription.handle = self._platform.subscribe(
            message.topic, message.type, message.qos, subscription.on_sample, lambda: self._confirm(number)
        )
        subscription.handle.on_dropped = subscription.on_dropped
        subscription.update(message, self._platform.encoding, self._report_loss)
        self._subscriptions[number] = subscription
        self._confirm(number)
        if topic in self._inhibited:
            self._apply_inhibition(number, topic)

    def _confirm(self, number: int) -> None:
        subscription = self._subscriptions.get(number)
        if subscription is None:
            return
        handle, request = subscription.handle, subscription.request
        self.sample_queue.open(number, request.throttle_ms / 1000, handle.latched, handle.publishers)
        self._writer.send(
            link.Subscribed(
                number=number,
                topic=request.topic,
                type=handle.type,
                encoding=self._platform.encoding,
                latched=handle.latched,
                publishers=handle.publishers,
                replays=handle.stamps_id,
                unmatched=handle.unmatched,
            )
        )

    def _report_loss(self, loss: link.SamplesDropped) -> None:
        """Report samples that were not sent."""
        self._writer.send(loss)
        subscription = self._subscriptions.get(loss.number)
        if subscription is not None and loss.reason == TOO_LARGE and not subscription.logged_too_large:
            subscription.logged_too_large = True
            self._log.warn(
                "{topic}: a sample of {size} bytes is too large to be sent ([ros] largest_sample_mb here, "
                "--largest-sample-mb of the relay); this is logged once for each subscription",
                topic=subscription.topic,
                size=loss.size,
            )

    def _repeat_latched(self, subscription: _RelaySubscription, known: frozenset[int]) -> None:
        try:
            subscription.repeat_latched(known)
        except Exception:
            # The subscription itself still works.
            self._log.failure(
                "the latched samples of {topic} could not be requested", topic=subscription.topic
            )
            self._scheduler.enqueue_latched(subscription.request.number, 0, b"")

    def _apply_inhibition(self, number: int, topic: str) -> None:
        hold = self._inhibited.get(topic)
        if hold is None:
            self._scheduler.end_inhibition(number)
        else:
            self.sample_queue.inhibit(number, hold)

    def _unsubscribe(self, number: int) -> None:
        subscription = self._subscriptions.pop(number, None)
        if subscription is not None:
            subscription.close_thinner()
            subscription.handle.close()
            self._scheduler.close_subscription(number)

    def _advertise(self, message: link.Advertise) -> None:
        number = message.number
        if number in self._publications:
            self._unadvertise(number)
        check_room(self._publications, "publications")
        # Motion is recognised by resolved names, however the relay spells them.
        topic = self._platform.resolve(message.topic, message.type)
        confirm = partial(self._confirm_advertised, message, topic.type)
        if self._motion.policy.moves_by_topic(topic.name, topic.type):
            self._publications[number] = self._advertise_motion(number, topic, confirm)
            self._log.info("a client may command motion on {topic}", topic=topic.name)
        elif self._goal_topics is not None and self._goal_topics.matches(topic):
            # Not latched: for each late joiner the goal would start motion again.
            handle = self._platform.advertise(*topic, False, MOTION_QOS, on_change=confirm)
            id = self._goal_id(number)
            self._goal_topics.open(id, topic, handle)
            self._publications[number] = _RelayPublication(handle, topic.name, goal_id=id)
        else:
            handle = self._platform.advertise(*topic, message.latch, message.qos, message.queue_size, confirm)
            self._publications[number] = _RelayPublication(handle, topic.name)
        confirm()

    def _goal_id(self, number: int | str) -> str:
        return f"{self.name}/{number}"

    def _confirm_advertised(self, message: link.Advertise, type: str) -> None:
        publication = self._publications.get(message.number)
        if publication is None:
            return
        self._writer.send(
            link.Advertised(
                number=message.number,
                topic=message.topic,
                type=type,
                encoding=self._platform.encoding,
                motion=publication.moves,
                unmatched=publication.handle.unmatched,
            )
        )

    def _advertise_motion(self, number: int, topic: TypedTopic, confirm: OnChange) -> _RelayPublication:
        id = f"{self.name}/{number}"
        handle = self._platform.advertise(*topic, False, MOTION_QOS, on_change=confirm)
        try:
            self._motion.open(id, topic, handle)
        except SwitchboardError:
            handle.close()
            raise
        return _RelayPublication(handle, topic.name, motion_id=id)

    def _advertise_service(self, message: link.AdvertiseService) -> None:
        self._gate.check_advertise(message.service)
        self._services.advertise(message)

    def _end_publication(self, number: int) -> None:
        publication = self._publications.get(number)
        if publication is None or publication.goal_id is None or self._goal_topics is None:
            self._unadvertise(number)
        else:
            del self._publications[number]
            self._goal_topics.end(publication.goal_id)

    def _unadvertise(self, number: int) -> None:
        publication = self._publications.pop(number, None)
        if publication is None:
            return
        if publication.motion_id is not None:
            self._motion.close(publication.motion_id)
        elif publication.goal_id is not None and self._goal_topics is not None:
            self._goal_topics.close(publication.goal_id)
        else:
            publication.handle.close()

    def _get_type(self, message: link.GetType) -> None:
        self._writer.send(self._platform.definition(message.type))

    def _get_interfaces(self, message: link.GetInterfaces) -> None:
        self._writer.send(link.Interfaces(types=self._platform.interfaces()))

    def _fail(self, message: link.Message, reason: str) -> None:
        if isinstance(message, link.CallService):
            self._writer.send(link.ServiceResponse(id=message.id, result=False, reason=reason))
        elif isinstance(message, link.SendActionGoal):
            self._writer.send(refusal(message, reason))
        else:
            what = link.lower_tag(type(message).__name__)
            ref = getattr(message, _REFERENCE.get(type(message), "number"), "")
            self._writer.send(link.Failed(request=what, reference=str(ref), reason=reason))


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
"""Field that identifies a failed request; for topics it is ``number``."""


class ChannelConnection(ChannelWriter):
    """The owner of a channel's link: passes the link's events to the channel, and writes the channel's messages.

    :param on_lost: called with the reason when the connection is closed
    """

    def __init__(
        self, name: str, protocol: LinkProtocol, on_lost: Callable[[ChannelConnection, str], None]
    ) -> None:
        self.name = name
        self.protocol = protocol
        self.channel: RobotChannel
        self._on_lost = on_lost

    def send(self, message: link.Message) -> None:
        self.protocol.link.send(message)
        self.protocol.flush()

    @property
    def room(self) -> int:
        return self.protocol.room

    def write(self, frames: list[bytes]) -> None:
        self.protocol.write(frames)

    def on_event(self, event: Event) -> None:
        if isinstance(event, SampleReceived | CommandReceived):
            self.channel.publish(event.frame)
        elif isinstance(event, MessageReceived):
            self.channel.handle(event.message)
        elif isinstance(event, JoinedChannel) and event.channel != self.name:
            reason = f"the relay joined this link to the channel '{event.channel}' instead of '{self.name}'"
            self.protocol.end(LinkLost(reason))
        elif isinstance(event, LinkEnded):
            self.protocol.end(LinkLost(f"the relay closed the channel: {event.reason}"), gently=True)

    def on_lost(self, reason: SwitchboardError) -> None:
        self._on_lost(self, str(reason))

    def on_pause(self) -> None:
        self.channel.pause()

    def on_resume(self) -> None:
        self.channel.resume()
