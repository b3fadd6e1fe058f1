"""One pipe that runs or waits: a client of the source robot that subscribes, and one of the target that publishes.

Where an end is a service or an action, that client calls it. A program has no robot of its own: both clients are then
at the robot of the other end, and :class:`relay_server.pipes.program_end.ProgramEnd` reaches the program.

Rights, control, throttling and the age of commands are those of sessions. A pipe that moves a robot ends when that
robot is stopped, when control or the link of either robot is lost, and when a command is refused. Then only a user
starts it again.
"""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any, NamedTuple

import msgspec
from twisted.internet.defer import Deferred
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_db.queries import PipeRecord
from relay_protocol import jsontext, rosbridge
from relay_protocol.errors import Invalid, Refused, SwitchboardError, Unavailable
from relay_protocol.rights import Operation
from relay_protocol.ros_types import TypeRegistry
from relay_server.access import may_subscribe
from relay_server.channels.channel import Channel
from relay_server.channels.client_subscription import ClientSubscription
from relay_server.channels.names import normal_type, resolve
from relay_server.channels.offered_services import RESERVED
from relay_server.channels.robot_requests import RequestPhase
from relay_server.channels.samples import Sample
from relay_server.channels.states import ChannelState
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.icpi.programs import Program, ProgramRegistry
from relay_server.in_process_sessions.in_process_port import InProcessPort, ServiceReply
from relay_server.pipes.cycles import EndKey, end_key
from relay_server.pipes.fields import ANY, FieldConverter, check_mapping, type_of_field
from relay_server.pipes.program_end import ANY_TYPE, ProgramEnd
from relay_server.pipes.schemas import PipeEnd, PipeSettings
from relay_server.pipes.service_caller import PipeCall, ServiceCaller, goal_request, service_request
from relay_server.robots.registry import ControlLinkPort, RobotState
from relay_server.sessions.context import ClientContext
from relay_server.sessions.ports import ActivityListener

NO_ARGUMENTS = b"{}"

_RECENT = 0.05
"""Weight of the latest message in the mean latency."""


class PipePort(InProcessPort):
    """The port of a pipe's session with one of its robots.

    :ivar pipe: set before the session begins
    """

    pipe: RunningPipe

    def deliver(self, subscription: ClientSubscription, sample: Sample) -> None:
        """Carry a sample, unconverted."""
        self.pipe.receive(sample)

    def status(self, level: str, text: str, id: rosbridge.Id = None) -> None:
        """An error of something that was accepted before concerns the pipe."""
        # A call or goal gets its error as its answer, too.
        answered = self._performing is not None or str(id) in self._calls or str(id) in self._goals
        super().status(level, text, id)
        if level == "error" and not answered:
            lost = self.client.channel.state is not ChannelState.OPEN
            # What is lost with a robot's link was not refused.
            self.pipe.failed(Unavailable(text) if lost else Refused(text))

    def warn_of_drops(self, text: str, id: rosbridge.Id = None) -> None:
        """Show that messages are dropped on the way to the robot."""
        self.pipe.failed(Unavailable(text))

    def rights_changed(self) -> None:
        """End the pipe if its owner lost a right that it needs."""
        self.pipe.check()


class PipeReply(NamedTuple):
    """The reply to a call of a pipe, or a value that a program publishes.

    :param owner_id: of the pipe or program
    :param key: of the service, function or port
    :param body: JSON
    :param earliest_sent: of the call or value, see :class:`relay_server.sessions.message_age.MessageAge`
    """

    owner_id: int
    key: EndKey
    body: bytes
    earliest_sent: int


class _Types(NamedTuple):
    """The inputs of a converter. Robots get a new registry when they register again.

    :param source: of messages or replies
    :param target: of messages or requests
    """

    source: str
    target: str
    source_types: TypeRegistry
    target_types: TypeRegistry


class RunningPipe:
    """
    :param clock_ns: monotonic nanoseconds
    :param source: begins its session after this
    :param fresh: whether a user starts it now; otherwise it must not begin to move a robot
    :param on_end: called once with the reason when it must not run any longer
    :param on_reply: called with each reply of a service that is the target
    :ivar why: what it waits for; empty while it runs
    :ivar problem: why the latest message was not carried
    :ivar encoded: messages that were carried without decoding
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        record: PipeRecord,
        settings: PipeSettings,
        source: PipePort,
        target: PipePort,
        *,
        programs: ProgramRegistry,
        clock_ns: Callable[[], int],
        fresh: bool,
        on_end: Callable[[RunningPipe, str], None],
        on_reply: Callable[[PipeReply], object],
    ) -> None:
        self.record = record
        self.settings = settings
        self.why = "its robots"
        self.problem = ""
        self.moves = False
        self.ended = False
        self.messages = self.drops = self.encoded = 0
        self.latency: float | None = None
        self._clock = clock
        self._clock_ns = clock_ns
        self._source = source
        self._target = target
        self._fresh = fresh
        self._on_end = on_end
        self._on_reply = on_reply
        self._source_name = _name_of(settings.source)
        self._target_name = _name_of(settings.target)
        self._source_program, self._target_program = (
            ProgramEnd(programs, record.owner_id, end, gets=end is settings.source) if end.program else None
            for end in (settings.source, settings.target)
        )
        self._operation = rosbridge.Publish(topic=self._target_name)
        self._caller = None if settings.target.topic else self._make_caller()
        self._poller = None if settings.source.topic or not settings.rate else self._make_poller()
        self._polling: Timer | None = None
        self._subscribed = False
        self._links: tuple[ControlLinkPort | Program | None, ...] | None = None
        """Links of both robots, and a program, when it began to move a robot."""
        self._types: _Types | None = None
        self._converter: FieldConverter | None = None
        self._definitions_asked: set[tuple[TypeRegistry, str]] = set()
        self._earliest_sent = 0
        """Messages of the source that come now were sent after this; see :class:`MessageAge`."""
        self._pinging = False
        self._fastest: int | None = None
        """Least difference of the relay's and the source robot's clocks over all messages, nanoseconds."""

    def _make_caller(self) -> ServiceCaller:
        """Calls what is the target."""
        return ServiceCaller(
            self._target,
            self._target_name,
            _request(self._target, self.settings.target, self._target_program),
            answered=self._called,
            failed=self._not_called,
            dropped=self._drop,
        )

    def _make_poller(self) -> ServiceCaller:
        """Calls what is the source."""
        return ServiceCaller(
            self._source,
            self._source_name,
            _request(self._source, self.settings.source, self._source_program),
            answered=self._polled,
            failed=self._not_polled,
            dropped=self._drop,
        )

    @property
    def target_robot(self) -> RobotState:
        """The robot to which it carries."""
        return self._target.client.robot

    def begin(self) -> None:
        """Both sessions have begun."""
        context = self._target.client
        session_changed = context.control_changed

        def control_changed() -> None:
            session_changed()
            self._control_changed()

        context.control_changed = control_changed
        for each in (self._source.client, context):
            each.activity = _without_repeated_calls(each.activity)
        self.check()

    # --- state --------------------------------------------------------------------------------------------

    def check(self) -> None:
        """Begin, wait or end, as rights, robots and topics are now."""
        if self.ended:
            return
        try:
            self.why = self._prepare()
        except Unavailable as error:
            self.why = str(error)
        except SwitchboardError as error:
            self.end(str(error))
            return
        if self.why:
            self._unsubscribe()

    def end(self, reason: str) -> None:
        """End for good, with a reason for people."""
        if not self.ended:
            self.close()
            self._on_end(self, reason)

    def close(self) -> None:
        """End both sessions. Control of a robot is released."""
        self.ended = True
        cancel(self._polling)
        if self.moves:
            target = self._target.client
            # A user may start another one at once: it does not continue this one.
            target.controller.release(target, "the pipe has ended")
        for port in (self._target, self._source):
            port.on_close = _nothing
            port.session.end(orderly=True)

    def robot_stopped(self) -> None:
        """The target robot was stopped. A pipe that may move it ends, or does not begin by itself."""
        self._fresh = False
        if self.moves:
            self.end(f"robot {self.target_robot.name} was stopped; start the pipe again when it may move")

    def _control_changed(self) -> None:
        """End if another client has, or gets, control of the robot that it moves."""
        context = self._target.client
        try:
            self._check_control(context)
        except Refused as error:
            self.end(str(error))

    def _check_control(self, context: ClientContext) -> None:
        """:raises Refused: another client has, or gets, control of the robot that it moves"""
        lease = context.controller.lease
        holder = lease.pending_holder or lease.holder
        if self.moves and holder is not None and holder.client is not context:
            name = holder.client.name
            raise Refused(f"{name} has control of robot {context.robot.name}; start the pipe again")

    def failed(self, error: SwitchboardError) -> None:
        """A message was not carried. It ends a pipe that moves a robot if a client would have to release control."""
        if self.ended:
            return
        self.drops += 1
        self.problem = str(error)
        lease = self._target.client.controller.lease
        free = lease.holder is None and lease.pending_holder is None
        if self.moves and isinstance(error, Refused) and (lease.settled or not free):
            # Otherwise control is just being released, by a pipe that was stopped or another client.
            self.end(str(error))
        else:
            self.check()

    def _prepare(self) -> str:
        """What it waits for; empty if it runs now.

        :raises Unavailable: it waits for a robot
        :raises SwitchboardError: it can't run
        """
        source, target = self._source.client, self._target.client
        self._require_rights()
        for robot in (source.robot, target.robot):
            if robot.control_link is None:
                self._lost(f"robot {robot.name} went offline")
                return f"robot {robot.name}, which is {robot.absence}"
        for program in (self._source_program, self._target_program):
            if program is not None and program.find() is None:
                self._lost(f"{program} has disconnected")
                return f"{program}, which is not connected"
        source_type = self._find_source_type()
        if not source_type:
            return f"{_words(self.settings.source)} of robot {source.robot.name}"
        target_type = self._find_target_type(source_type)
        if not target_type:
            more = "" if self._caller else "; give its type to create it"
            return f"{_words(self.settings.target)} of robot {target.robot.name}{more}"
        self._check_motion(target_type)
        unknown = self._ask_definitions(source_type, target_type)
        if unknown:
            return unknown
        if self._caller is None and not self._advertise(target_type):
            return f"robot {target.robot.name} to publish {self._target_name}"
        if self.settings.source.topic:
            self._subscribe(source_type)
        elif self._poller is not None and self._polling is None:
            self._poll()
        return ""

    def _find_source_type(self) -> str:
        """The type of the messages or replies of the source; empty: it is not there."""
        source, end = self._source.client, self.settings.source
        if end.program:
            return ANY_TYPE
        if end.service:
            found = _service_type(source, end)
            return f"{found}_Response" if found else ""
        if end.action:
            found = _action_type(source, end)
            return f"{found}_Result" if found else ""
        return normal_type(end.type) or source.robot.graph.topic_type(self._source_name) or ""

    def _find_target_type(self, source_type: str) -> str:
        """The type of the messages or requests of the target; empty: it is not there.

        :raises Invalid: it is not that of the source, but whole messages are carried
        """
        target, end = self._target.client, self.settings.target
        if end.program:
            return ANY_TYPE
        if end.service:
            found = _service_type(target, end)
            return f"{found}_Request" if found else ""
        if end.action:
            found = _action_type(target, end)
            return f"{found}_Goal" if found else ""
        target_type = normal_type(end.type) or target.channel.publications.known_type(self._target_name)
        if not self.settings.fields and source_type != ANY_TYPE:
            target_type = target_type or source_type
            if target_type != source_type:
                raise Invalid(
                    f"{self._source_name} has the type {source_type} and {self._target_name} has {target_type}; "
                    "whole messages need the same type, so carry fields"
                )
        return target_type or ""

    def _require_rights(self) -> None:
        """:raises Refused: the owner lacks a right"""
        self._require_source_right()
        target = self._target.client
        if self._target_program is not None:
            return
        operation = Operation.CALL if self._caller else Operation.PUBLISH
        decision = target.permit.decide(operation, self._target_name)
        if not decision.allowed:
            raise Refused(f"{target.robot.name}: {decision.reason}")

    def _require_source_right(self) -> None:
        """:raises Refused: the owner may not subscribe to the source, or not call it"""
        source, given = self._source.client, self.settings.source.type
        if self._source_program is not None:
            return
        if not self.settings.source.topic:
            decision = source.permit.decide(Operation.CALL, self._source_name)
            if not decision.allowed:
                raise Refused(f"{source.robot.name}: {decision.reason}")
            return
        decision = may_subscribe(
            source.permit.decide, source.robot, self._source_name, [normal_type(given)] if given else ()
        )
        known = self._source_name in source.robot.graph.topics or given
        if not decision.allowed and (
            known or not source.permit.decide(Operation.SUBSCRIBE, self._source_name).allowed
        ):
            raise Refused(f"{source.robot.name}: {decision.reason}")

    def _lost(self, why: str) -> None:
        """:raises Refused: it was moving a robot"""
        self._fresh = False
        if self._links is not None:
            raise Refused(f"{why}, and the pipe moves a robot; start it again")

    def _check_motion(self, target_type: str) -> None:
        """Find out whether it moves the target.

        :raises Refused: it does, and must not begin or go on; or its source would be moved by asking it
        """
        source, target = self._source.client.robot, self._target.client
        if (
            self._poller is not None
            and self._source_program is None
            and source.description.motion.moves_by_service(self._source_name)
        ):
            raise Refused(
                f"service {self._source_name} moves robot {source.name}, so it can't be a source with a rate"
            )
        robot = target.robot
        if self._target_program is not None:
            self.moves = False
        elif self.settings.target.action:
            self.moves = robot.description.motion.moves_by_action(self._target_name)
        elif self._caller is not None:
            self.moves = robot.description.motion.moves_by_service(self._target_name)
        else:
            self.moves = robot.is_motion(
                self._target_name, target_type
            ) or target.channel.publications.is_motion(self._target_name)
        if not self.moves:
            return
        if not self._fresh and self._links is None:
            raise Refused(f"it moves robot {robot.name}; start it again while both robots are online")
        if target.controller.snapshot.stopped is not None:
            raise Refused(f"robot {robot.name} is stopped; resume it, then start the pipe")
        self._check_control(target)
        self._check_links()

    def _check_links(self) -> None:
        """:raises Refused: a robot or program has connected again since it began to move a robot"""
        links = (
            self._source.client.robot.control_link,
            self._target.client.robot.control_link,
            None if self._source_program is None else self._source_program.find(),
        )
        if self._links is None:
            self._links = links
        elif any(before is not now for before, now in zip(self._links, links, strict=True)):
            what = "robot or program" if self._source_program is not None else "robot"
            raise Refused(f"a {what} has connected again, and the pipe moves a robot; start it again")

    # --- definitions --------------------------------------------------------------------------------------

    def _ask_definitions(self, source_type: str, target_type: str) -> str:
        """Request the definitions that are needed; what it waits for, if they are not known yet.

        :raises Invalid: fields do not fit, or the robots' definitions differ
        """
        source, target = self._source.client, self._target.client
        types = _Types(source_type, target_type, source.robot.types, target.robot.types)
        if self._types is not None and all(a is b or a == b for a, b in zip(types, self._types, strict=True)):
            return ""
        if self.settings.fields or self._whole_without_decoding:
            for context, name in ((source, source_type), (target, target_type)):
                if not self._knows(context, name):
                    return f"the definition of {name} by robot {context.robot.name}"
        if self.settings.fields:
            self._converter = self._make_converter(types)
        elif self._whole_without_decoding:
            _check_same(types, source.robot, target.robot)
        self._types = types
        return ""

    @property
    def _whole_without_decoding(self) -> bool:
        robots = self._source.client.robot, self._target.client.robot
        ends = self.settings.source, self.settings.target
        return (
            not self.settings.fields
            and not self.moves
            and all(each.topic for each in ends)
            and all("cdr" in each.encodings for each in robots)
        )

    def _knows(self, context: ClientContext, type_name: str) -> bool:
        """Whether a robot's definition is known; it is requested once. That of a program's values need not be."""
        if type_name == ANY_TYPE:
            return True
        types = context.robot.types
        if types.knows(type_name):
            return True
        asked = (types, type_name)
        if asked not in self._definitions_asked:
            self._definitions_asked.add(asked)
            request = Deferred.fromCoroutine(_definition(context.channel, type_name))
            request.addCallbacks(
                lambda _: self._defined(context, type_name), lambda f: self._undefined(f, asked)
            )
        return types.knows(type_name)

    def _defined(self, context: ClientContext, type_name: str) -> None:
        if not context.robot.types.knows(type_name):
            self.end(
                f"robot {context.robot.name} has no definition of {type_name}, so its fields are unknown"
            )
        else:
            self.check()

    def _undefined(self, failure: Failure, asked: tuple[TypeRegistry, str]) -> None:
        failure.trap(SwitchboardError)
        if isinstance(failure.value, Unavailable):
            self._definitions_asked.discard(asked)
        else:
            self.end(str(failure.value))

    def _make_converter(self, types: _Types) -> FieldConverter:
        """:raises Invalid: a field does not exist, or its values can't become those of the other"""
        source, target = (
            {} if name == ANY_TYPE else registry.definitions(name)
            for registry, name in ((types.source_types, types.source), (types.target_types, types.target))
        )
        mappings = []
        for each in self.settings.fields:
            kind = ANY if types.target == ANY_TYPE else type_of_field(target, types.target, each.target)
            check_mapping(
                each,
                ANY if types.source == ANY_TYPE else type_of_field(source, types.source, each.source),
                kind,
            )
            mappings.append((each, kind))
        return FieldConverter(mappings)

    # --- topics -------------------------------------------------------------------------------------------

    def _advertise(self, target_type: str) -> bool:
        """Advertise the target's topic; whether the robot publishes it now."""
        target = self._target.client
        publications = target.channel.publications
        publication = publications.find(self._target_name, target)
        if publication is None:
            self._target.perform(
                rosbridge.Advertise(id="pipe", topic=self._target_name, type=target_type, latch=False)
            )
            publication = publications.find(self._target_name, target)
        return publication is not None and publication.phase is RequestPhase.ACTIVE

    def _subscribe(self, source_type: str) -> None:
        if self._subscribed and self._source.session.subscriptions.is_subscribed(self._source_name):
            return
        self._subscribed = True
        rate = self.settings.rate
        self._source.perform(
            rosbridge.Subscribe(
                id="pipe",
                topic=self._source_name,
                type=source_type,
                throttle_rate=1000 / rate if rate else 0,
                compression="cbor-raw" if self._whole_without_decoding else "none",
            )
        )

    def _unsubscribe(self) -> None:
        cancel(self._polling)
        self._polling = None
        if self._subscribed and self._source.closed is None:
            self._subscribed = False
            self._source.perform(rosbridge.Unsubscribe(topic=self._source_name))

    # --- messages -----------------------------------------------------------------------------------------

    def receive(self, sample: Sample) -> None:
        """Carry one message of the source."""
        if not self._is_ready():
            return
        arrived = self._clock_ns()
        try:
            sent = self._carry(sample, arrived)
        except SwitchboardError as error:
            self.failed(error)
            return
        except Exception:
            self._broken()
            return
        if self._caller is None and sent:
            self._count(arrived)

    def _broken(self) -> None:
        """An error of the relay itself ends this pipe, and nothing else: not the source's data for others."""
        self.log.failure("pipe {name} failed on a message", name=self.record.name)
        self.end("the relay failed on a message; see its log")

    def receive_reply(self, reply: PipeReply) -> None:
        """Carry one answer of the service, action or function that is the source, or a value of the port."""
        if not self._is_ready():
            return
        arrived = self._clock_ns()
        try:
            # The call was made by the right of another session.
            self._require_source_right()
            self._target.client.quota.check()
            sent = self._convert_and_send(reply.body, arrived, reply.earliest_sent)
        except SwitchboardError as error:
            self.failed(error)
            return
        except Exception:
            self._broken()
            return
        if self._caller is None and sent:
            self._count(arrived)

    def carries_reply(self, reply: PipeReply) -> bool:
        """Whether a reply to a call by another pipe, or a published value, is to be carried."""
        return (
            self._poller is None
            and not self.settings.source.topic
            and self.record.owner_id == reply.owner_id
            and end_key(self.settings.source, self.record.source_robot_id, reply.owner_id) == reply.key
        )

    def _is_ready(self) -> bool:
        """Whether a message can be carried now; otherwise it is a drop."""
        if self.why and not self.ended:
            # A latched message may come while the subscription begins.
            self.check()
            if not self.ended and self.why:
                self.drops += 1
        return not self.ended and not self.why

    def _count(self, arrived: int) -> None:
        self.messages += 1
        self.problem = ""
        seconds = (self._clock_ns() - arrived) / 1e9
        self.latency = seconds if self.latency is None else self.latency + _RECENT * (seconds - self.latency)

    def _drop(self) -> None:
        self.drops += 1
        self.problem = f"{_words(self.settings.target)} was still at work when newer messages came"

    def _carry(self, sample: Sample, arrived: int) -> bool:
        """Send a message to the target; whether it was sent.

        :raises SwitchboardError: it can't be sent
        """
        context, handler = self._target.client, self._target.session.publish_handler
        context.quota.check()
        if (
            not self.settings.fields
            and not self.moves
            and self._caller is None
            and sample.converter.cdr
            and "cdr" in context.robot.encodings
        ):
            with context.age.as_of(arrived):
                sent = handler.publish_encoded(self._operation, sample.body)
            self.encoded += sent
            self.drops += not sent
            return sent
        with context.quota.timed():
            body = sample.json()
        if isinstance(body, SwitchboardError):
            raise body
        return self._convert_and_send(
            body, arrived, self._sent_after(sample, arrived) if self.moves else arrived
        )

    def _convert_and_send(self, body: bytes, arrived: int, earliest_sent: int) -> bool:
        """Send what a message becomes; whether it was sent. A service has not answered yet.

        :param body: JSON of a message or reply
        :raises SwitchboardError: it can't be sent
        """
        context = self._target.client
        with context.quota.timed():
            if self._converter is not None:
                body = jsontext.encode(self._converter.convert(jsontext.decode_any(body)))
            if self.moves:
                self._check_links()
            if self._caller is not None:
                args = body if self.settings.fields or self.settings.target.port else NO_ARGUMENTS
                self._caller.call(PipeCall(args, arrived, earliest_sent))
                return True
            stale, drops = context.motion.stale_commands, self.drops
            with context.age.as_of(earliest_sent):
                publish = rosbridge.Publish(topic=self._target_name, msg=msgspec.Raw(body))
                self._target.session.publish_handler.publish(publish)
        if context.motion.stale_commands > stale:
            self.drops += 1
            self.problem = self._too_old
        # A message that is none of the topic's type is a drop already.
        return self.drops == drops

    @property
    def _too_old(self) -> str:
        deadline_ms = self.target_robot.description.motion.deadline_ms
        name = self.target_robot.name
        return f"a message was dropped: it may be older than robot {name} takes commands ({deadline_ms} ms)"

    # --- services -----------------------------------------------------------------------------------------

    def _called(self, call: PipeCall, reply: bytes) -> None:
        """The target has answered."""
        if self.ended:
            return
        self._count(call.arrived)
        record, target = self.record, self.settings.target
        if not target.port:
            key = end_key(target, record.target_robot_id, record.owner_id)
            self._on_reply(PipeReply(record.owner_id, key, reply, call.earliest_sent))

    def _not_called(self, error: SwitchboardError, stale: bool) -> None:
        """A call was not made, or failed. A pipe that moves a robot ends, unless the command was only too old."""
        if stale:
            self.drops += 1
            self.problem = self._too_old
        else:
            self.failed(Refused(str(error)) if self.moves else error)

    def _not_polled(self, error: SwitchboardError, stale: bool) -> None:
        """The source was not called, or failed. Nothing reached the target, so that a pipe goes on."""
        if not self.ended:
            self.drops += 1
            self.problem = str(error)
            self.check()

    def _poll(self) -> None:
        """Call the source, and again after the time of the rate. It is not called while it is at work."""
        assert self._poller is not None
        self._polling = self._clock.callLater(1 / self.settings.rate, self._poll)
        if self._poller.busy:
            return
        now = self._clock_ns()
        try:
            self._source.client.quota.check()
        except SwitchboardError as error:
            self._not_polled(error, False)
        else:
            self._poller.call(PipeCall(NO_ARGUMENTS, now, now))

    def _polled(self, call: PipeCall, reply: bytes) -> None:
        """The source has answered."""
        record = self.record
        key = end_key(self.settings.source, record.source_robot_id, record.owner_id)
        self.receive_reply(PipeReply(record.owner_id, key, reply, call.earliest_sent))

    # --- age of commands ----------------------------------------------------------------------------------

    def ping(self) -> None:
        """Measure how old messages of the source can be, as it moves a robot.

        A message that comes after the answer to a ping was sent after that ping; see :class:`MessageAge`.
        """
        channel_link = self._source.client.channel.link_state.link
        if (
            not self.moves
            or self._pinging
            or self.ended
            or channel_link is None
            or not self.settings.source.topic
        ):
            return
        self._pinging = True
        sent = self._clock_ns()
        channel_link.round_trip().addCallbacks(self._answered, self._unanswered, callbackArgs=(sent,))

    def _answered(self, _: float, sent: int) -> None:
        self._pinging = False
        self._earliest_sent = max(self._earliest_sent, sent)

    def _unanswered(self, _: Failure) -> None:
        self._pinging = False

    def _sent_after(self, sample: Sample, arrived: int) -> int:
        """Earliest time at which the source robot can have received a message, monotonic nanoseconds.

        A pong may pass messages that wait in the robot for a slow link. Their stamps show by how much they took longer
        than the fastest one.
        """
        if self._source.client.robot.description.sim_time:
            return self._earliest_sent
        difference = arrived - sample.ros_time_ns
        self._fastest = difference if self._fastest is None else min(self._fastest, difference)
        return min(self._earliest_sent, arrived - (difference - self._fastest))


async def _definition(channel: Channel, type_name: str) -> None:
    await channel.requests.definition(type_name)


def _check_same(types: _Types, source: RobotState, target: RobotState) -> None:
    """:raises Invalid: the robots have different definitions of the type, so CDR means another thing to each"""
    if types.source_types.full_text(types.source) != types.target_types.full_text(types.target):
        raise Invalid(
            f"robots {source.name} and {target.name} have different definitions of {types.source}; carry fields"
        )


def check_service(service: str) -> None:
    """:raises Invalid: it is one of the relay's own services, which a pipe must not call"""
    if resolve(service).startswith(RESERVED):
        raise Invalid(f"{service} is a service of the relay; a pipe calls services of robots")


def _service_type(context: ClientContext, end: PipeEnd) -> str:
    """The type of a service of a robot, or of a client that offers it; empty: there is none.

    :raises Invalid: the pipe's settings have another
    """
    name = resolve(end.service)
    offered = context.channel.services.find_usable(name)
    found = offered.type if offered is not None else context.robot.graph.service_type(name) or ""
    return _checked_type(context, end, found, "srv")


def _without_repeated_calls(activity: ActivityListener) -> ActivityListener:
    """Publishes only the first call of a pipe, as it publishes only the first message to a topic."""
    published = set()

    def publish(kind: str, **data: Any) -> None:
        if kind not in published:
            activity(kind, **data)
        if kind in ("call.begun", "call.ended"):
            published.add(kind)

    return publish


def _action_type(context: ClientContext, end: PipeEnd) -> str:
    """The type of an action of a robot, or of a client that offers it; empty: there is none.

    :raises Invalid: the pipe's settings have another
    """
    name = resolve(end.action)
    offered = context.channel.actions.find_usable(name)
    found = offered.type if offered is not None else context.robot.graph.action_type(name) or ""
    return _checked_type(context, end, found, "action")


def _checked_type(context: ClientContext, end: PipeEnd, found: str, kind: str) -> str:
    """:raises Invalid: the pipe's settings have another type"""
    given = normal_type(end.type, kind)
    if found and given and given != found:
        raise Invalid(f"{_words(end)} of robot {context.robot.name} has the type {found}, not {given}")
    return found


def _request(
    port: PipePort, end: PipeEnd, program: ProgramEnd | None
) -> Callable[[PipeCall], Coroutine[Any, Any, ServiceReply]]:
    if program is not None:
        return program.request
    return (
        goal_request(port, resolve(end.action)) if end.action else service_request(port, resolve(end.service))
    )


def _name_of(end: PipeEnd) -> str:
    return end.address if end.program else resolve(end.name)


def _words(end: PipeEnd) -> str:
    if end.program:
        return end.address
    return f"{'service' if end.service else 'action' if end.action else 'topic'} {resolve(end.name)}"


def _nothing() -> None:
    pass
