"""A channel's lifecycle: every event in every state, and the effect on clients' requests."""

from __future__ import annotations

import re
from typing import Any

import pytest
from twisted.internet.defer import Deferred

from relay_protocol import link
from relay_protocol.errors import Refused
from relay_server.channels.channel import JOIN_SECONDS, REOPEN_SECONDS
from relay_server.channels.members import RequestContext
from relay_server.channels.states import NEXT, ChannelEvent, ChannelState
from tests.worlds.relay import MemoryLink, World, fails, text


class Member:
    """A member without requests."""

    def notify(self, level: str, text: str, id: Any = None) -> None:
        """Ignores it."""

    def recheck_rights(self) -> None:
        """Has all rights."""


def brought_to(world: World, state: ChannelState) -> None:
    """A channel that real events have brought to this state."""
    channel = world.channel
    if state is ChannelState.NEW:
        return
    channel.attach(Member())
    if state in (ChannelState.OPENING, ChannelState.OPEN):
        world.robot_comes()
    if state is ChannelState.OPEN:
        world.robot_joins()
    if state is ChannelState.CLOSED:
        channel.close()


@pytest.mark.parametrize("event", ChannelEvent)
@pytest.mark.parametrize("state", ChannelState)
def test_every_event_in_every_state(world: World, state: ChannelState, event: ChannelEvent) -> None:
    """The table lists all transitions; other events change nothing."""
    channel = world.channel
    brought_to(world, state)
    assert channel.state is state
    channel._handle(event)
    assert channel.state is NEXT.get((state, event), state)
    assert (channel.link_state.link is not None) == (
        state is ChannelState.OPEN and channel.state is ChannelState.OPEN
    )
    assert (channel in world.robot.observers) == (channel.state is not ChannelState.CLOSED)


def test_a_channels_name_does_not_disclose_their_number(world: World) -> None:
    """The robot receives the name and must not learn about other channels."""
    other = world.channels.of(world.registry.robot(2, "rover", "lab"))
    assert re.fullmatch(r"rover#[0-9a-f]{8}", world.channel.name)
    assert other.name != world.channel.name


def test_channel_to_an_offline_robot_is_not_opened(world: World) -> None:
    """The channel opens when the robot registers."""
    world.channel.attach(Member())
    assert world.channel.state is ChannelState.WAITING
    world.robot_comes()
    assert world.channel.state is ChannelState.OPENING
    world.robot_joins()
    assert world.channel.state is ChannelState.OPEN


def test_a_channel_lingers_after_its_last_member(world: World) -> None:
    """A client that returns in time finds it open; after that the robot is asked to close it."""
    world.robot_comes()
    channel, member = world.channel, Member()
    channel.attach(member)
    world.robot_joins()
    channel.detach(member)
    world.clock.advance(4.9)
    channel.attach(member)
    world.clock.advance(60)
    assert channel.state is ChannelState.OPEN
    channel.detach(member)
    world.clock.advance(5.1)
    assert channel.state is ChannelState.CLOSED
    assert world.link.closed
    assert len(world.control.all(link.CloseChannel)) == 1
    assert world.channel is not channel
    assert not [call for call in world.clock.getDelayedCalls() if call.active()]


def test_a_late_robot_is_asked_again_and_the_former_ticket_is_worthless(world: World) -> None:
    """Only the newest ticket opens the channel."""
    world.robot_comes()
    world.channel.attach(Member())
    world.clock.advance(0)
    first = world.control.take(link.OpenChannel)[-1].ticket
    world.clock.advance(JOIN_SECONDS)
    world.clock.advance(0)
    second = world.control.take(link.OpenChannel)[-1].ticket
    with pytest.raises(Refused):
        world.channels.redeem(first)
    assert world.channels.redeem(second) is world.channel


def test_a_ticket_is_good_once_and_for_a_time(world: World) -> None:
    """Used, expired and unknown tickets get the same error."""
    world.robot_comes()
    world.channel.attach(Member())
    world.clock.advance(0)
    ticket = world.control.take(link.OpenChannel)[-1].ticket
    assert world.channels.redeem(ticket) is world.channel
    old = world.channels._tickets.issue(world.channel)
    world.clock.advance(31)
    for each in (ticket, old, "unknown"):
        with pytest.raises(Refused, match="unknown, used or too old"):
            world.channels.redeem(each)


def test_tickets_do_not_outlive_their_channel(world: World) -> None:
    world.robot_comes()
    channel = world.channel
    channel.attach(Member())
    world.clock.advance(0)
    channel.close()
    assert not len(world.channels._tickets)
    assert not list(world.channels)


def test_a_second_link_to_an_open_channel_is_refused(world: World) -> None:
    """The first link stays."""
    world.robot_comes()
    world.channel.attach(Member())
    first = world.robot_joins()
    second = MemoryLink()
    world.channel.joined(second)
    assert second.closed
    assert first.closed is None
    world.channel.link_lost(second)
    assert world.channel.state is ChannelState.OPEN


def test_a_broken_link_is_requested_again_after_a_pause(world: World) -> None:
    world.robot_comes()
    world.channel.attach(Member())
    broken = world.robot_joins()
    world.channel.link_lost(broken)
    assert world.channel.state is ChannelState.OPENING
    world.clock.advance(REOPEN_SECONDS / 2)
    assert not world.control.all(link.OpenChannel)
    world.clock.advance(REOPEN_SECONDS / 2)
    assert len(world.control.all(link.OpenChannel)) == 1


def test_a_robot_that_registers_again_gets_a_new_channel_link(world: World) -> None:
    """The former channel link and the former control link are closed."""
    world.robot_comes()
    world.channel.attach(Member())
    former_control, former = world.control, world.robot_joins()
    world.robot_comes()
    assert former.closed
    assert former_control.closed
    assert world.robot_joins() is world.channel.link_state.link


def test_subscriptions_resume_when_the_robot_is_back(world: World) -> None:
    """Subscriptions and publications are replayed, unnoticed by clients."""
    person = world.person()
    world.working()
    person.says("subscribe", topic="/chatter")
    person.says("advertise", topic="/cmd_vel", type="geometry_msgs/Twist")
    number = world.link.all(link.Subscribe)[0].number
    world.define()
    world.robot_goes()
    world.working()
    assert [ask.topic for ask in world.link.all(link.Subscribe)] == ["/chatter"]
    assert [ask.topic for ask in world.link.all(link.Advertise)] == ["/cmd_vel"]
    world.subscribed(number)
    world.define()
    world.channel.sample(number, text("again"))
    assert [each["msg"] for each in person.received("publish")] == [{"data": "again"}]


def test_callers_wait_for_the_channel_and_fail_when_the_robot_goes(world: World) -> None:
    """Requests wait while the channel opens, and fail with a reason if the robot is lost meanwhile."""
    world.robot_comes()
    world.channel.attach(Member())
    reported: list[Any] = []
    asking = Deferred.fromCoroutine(world.channel.requests.definition("std_msgs/msg/String"))
    asking.addErrback(lambda failure: reported.append(str(failure.value)))
    assert not reported
    world.robot_goes()
    assert reported == ["robot rover is offline"]
    assert fails(world.channel.requests.definition("std_msgs/msg/String")) == "robot rover is offline"


def test_waiting_for_a_robot_that_never_joins_ends(world: World) -> None:
    """Requests for a round trip, a definition and a service all end with a reason."""
    world.robot_comes()
    world.channel.attach(Member())
    reported: list[str] = []
    for work in (
        world.channel.requests.round_trip(),
        world.channel.requests.definition("std_msgs/msg/String"),
        world.channel.requests.call("/reset", "", b"", 2.0, RequestContext(1)),
    ):
        Deferred.fromCoroutine(work).addErrback(lambda failure: reported.append(str(failure.value)))
    world.clock.pump([1.0] * 4)
    assert reported == ["robot rover did not answer within 4 s"]
    world.clock.pump([1.0] * 30)
    assert reported[1:] == ["robot rover did not answer within 30 s"] * 2


def test_a_round_trip_is_what_the_link_measures(world: World) -> None:
    world.robot_comes()
    world.channel.attach(Member())
    world.robot_joins()
    results: list[Any] = []
    Deferred.fromCoroutine(world.channel.requests.round_trip()).addBoth(results.append)
    world.link.pings[0].callback(0.25)
    assert results == [0.25]


def test_detaching_gives_everything_back(world: World) -> None:
    """The robot unsubscribes and unadvertises; all names are free again."""
    people = [world.person(), world.person()]
    world.working()
    for person in people:
        person.says("subscribe", topic="/chatter")
        person.says("subscribe", topic="/later", type="std_msgs/String")
        person.says("advertise", topic="/cmd_vel", type="geometry_msgs/Twist")
        person.says("publish", topic="/new", type="std_msgs/String", msg={"data": "x"})
    assert world.channel.link_state.names_in_use == 4
    people[0].session.end()
    assert world.channel.link_state.names_in_use == 4
    assert not world.link.all(link.Unsubscribe)
    people[1].session.end()
    assert world.channel.link_state.names_in_use == 0
    assert len(world.link.all(link.Unsubscribe)) == 2
    assert len(world.link.all(link.Unadvertise)) == 2
    assert not world.channel.members
    for part in (world.channel.subscriptions, world.channel.publications):
        assert not part._topics
        assert not (part.by_number if part is world.channel.subscriptions else part._by_number)


def test_ping_serves_all_waiting_requests(world: World) -> None:
    """A thousand pings by clients cost the robot one ping at a time."""
    world.robot_comes()
    world.person()
    world.robot_joins()
    results: list[object] = []
    for _ in range(3):
        Deferred.fromCoroutine(world.channel.requests.round_trip()).addBoth(results.append)
    assert len(world.link.pings) == 1
    world.link.pings[0].callback(0.25)
    assert results == [0.25, 0.25, 0.25]
    Deferred.fromCoroutine(world.channel.requests.round_trip())
    assert len(world.link.pings) == 2
