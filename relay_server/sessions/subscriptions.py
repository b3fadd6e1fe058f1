"""What a client listens to: topics of the robot, and those of the relay itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from relay_protocol import jsontext, rosbridge
from relay_protocol.errors import Refused
from relay_protocol.rights import Operation, Verdict
from relay_protocol.ros_types import TypeRegistry
from relay_server.access import may_subscribe
from relay_server.channels import encodings
from relay_server.channels.client_subscription import ClientSubscription
from relay_server.channels.robot_link import resolve
from relay_server.channels.samples import Converter, Sample
from relay_server.common.clock import Clock
from relay_server.common.timers import PeriodicTimer, PeriodicTimers
from relay_server.sessions.type_names import normal_type

if TYPE_CHECKING:
    from relay_server.sessions.ports import LocalNode
    from relay_server.sessions.session import Session

SUBSCRIPTIONS = 1024
"""Topics one connection may have subscribed."""

TELL_SECONDS = 1.0
"""How often the relay publishes its own topics."""

_OWN = Converter(TypeRegistry(), "", "json", lambda reason: None)
"""For what the relay itself says, which is JSON."""


class SubscriptionHandler:
    """The subscriptions of one session."""

    def __init__(self, session: Session, clock: Clock, local: LocalNode, rounds: PeriodicTimers) -> None:
        self._session = session
        self._clock = clock
        self._local = local
        self._listeners: dict[str, ClientSubscription] = {}
        self._rounds = rounds
        self._telling: PeriodicTimer | None = None

    def end(self) -> None:
        """The client is gone."""
        self._stop_telling()
        for listener in self._listeners.values():
            listener.close()

    def subscribe(self, ask: rosbridge.Subscribe) -> None:
        """One more subscription; several of one topic are merged."""
        session = self._session
        topic = resolve(ask.topic)
        type_name = normal_type(ask.type)
        verdict = self._judged(topic, type_name)
        if not verdict.allowed:
            raise Refused(verdict.reason)
        form = encodings.asked(ask, session.tell, topic=True)
        listener = self._listeners.get(topic)
        if listener is None:
            if len(self._listeners) >= SUBSCRIPTIONS:
                raise Refused(f"at most {SUBSCRIPTIONS} topics can be subscribed on one connection")
            listener = ClientSubscription(self._clock, session, topic)
        if self._local.topic(topic) is not None:
            listener.add(ask, form)
            self._listeners[topic] = listener
            if self._local.pushed(topic):
                session.desk.pushing.follow(session, self._push)
                self._push()
            elif self._telling is None:
                self._telling = PeriodicTimer(self._publish_local, TELL_SECONDS)
                self._rounds.start(self._telling)
            return
        subscriptions = session.channel.subscriptions
        subscriptions.check(topic, type_name)
        listener.add(ask, form)
        subscriptions.add(session, listener, type_name, ask.qos)
        self._listeners[topic] = listener

    def unsubscribe(self, ask: rosbridge.Unsubscribe) -> None:
        """One subscription less, or none of a topic any more."""
        topic = resolve(ask.topic)
        listener = self._listeners.get(topic)
        if listener is None:
            return
        if ask.id is not None and listener.remove(ask.topic, ask.id):
            if self._local.topic(topic) is None:
                self._session.channel.subscriptions.add(self._session, listener, None, None)
            return
        self._drop(topic)

    def hears(self, topic: str) -> bool:
        """Whether a topic is subscribed, still."""
        return topic in self._listeners

    def drops(self) -> dict[str, int]:
        """Samples the client did not take in time, by topic."""
        counted = self._session.outbox.drops
        return {
            topic: counted[listener] for topic, listener in self._listeners.items() if listener in counted
        }

    def lost(self) -> dict[str, Mapping[str, int]]:
        """Samples of the subscribed topics that no client got, by topic and reason."""
        subscriptions = self._session.channel.subscriptions
        return {topic: subscriptions.losses(topic) for topic in self._listeners}

    def judge_again(self) -> None:
        """What the client may not hear any more ends: its rights have changed, or what the topics are."""
        for topic in list(self._listeners):
            verdict = self._judged(topic)
            if not verdict.allowed:
                ids = self._listeners[topic].ids
                self._drop(topic)
                for id in ids:
                    self._session.tell("error", f"unsubscribed from {topic}: {verdict.reason}", id)

    def _judged(self, topic: str, type_name: str = "") -> Verdict:
        session = self._session
        if self._local.topic(topic) is not None:
            return session.permit.judge(Operation.SUBSCRIBE, topic)
        said = type_name or session.channel.subscriptions.type_for(session, topic)
        return may_subscribe(session.permit.judge, session.robot, topic, [said] if said else ())

    def _drop(self, topic: str) -> None:
        listener = self._listeners.pop(topic)
        listener.close()
        self._session.outbox.forget(listener)
        self._session.channel.subscriptions.remove(self._session, topic)

    def _publish_local(self) -> None:
        if not self._tell(pushed=False):
            self._stop_telling()

    def _push(self) -> None:
        if not self._tell(pushed=True):
            self._session.desk.pushing.forget(self._session)
        elif self._session.desk.standing.stopped is not None:
            # Who knows that the robot stands may let it move again at once.
            self._session.ping()

    def _tell(self, *, pushed: bool) -> bool:
        """Publish the relay's own topics of one kind; whether any is subscribed."""
        makers: list[tuple[str, Callable[[Session], dict[str, Any]] | None]] = [
            (name, self._local.topic(name)) for name in self._listeners if self._local.pushed(name) is pushed
        ]
        for name, make in makers:
            if make is not None:
                body = jsontext.encode(make(self._session))
                self._listeners[name].replay(Sample(body, 0, _OWN))
        return any(make for _, make in makers)

    def _stop_telling(self) -> None:
        if self._telling is not None:
            self._telling.stop()
            self._telling = None
