"""Requests, samples and the end of a channel."""

from __future__ import annotations

from typing import get_args

import pytest
from twisted.internet.defer import Deferred

from relay_protocol import link
from relay_protocol.frames import CommandFrame, SampleFrame
from relay_protocol.link import MotionPolicy
from robot_client.motion.motion_control import IDLE_TOPIC_SECONDS, MOTION_QOS
from robot_client.motion.motion_topics import MAX_TOPICS
from robot_client.platforms.base import CANCELED, GoalOutcome, GraphView
from tests.worlds.memory_platform import TWIST, MemorySubscription, twist
from tests.worlds.robot_channel import DRIVER, STRING, ChannelWorld
from tests.worlds.robot_failures import broken


@pytest.fixture
def world() -> ChannelWorld:
    return ChannelWorld()


def test_subscribe_is_confirmed_with_type_and_encoding(world: ChannelWorld) -> None:
    """The type comes from the graph where none is given."""
    answer = world.request(link.Subscribe(number=1, topic="/chat"))
    assert answer == link.Subscribed(number=1, topic="/chat", type=STRING, encoding="cdr", publishers=1)


def test_samples_carry_number_and_wall_clock(world: ChannelWorld) -> None:
    world.request(link.Subscribe(number=9, topic="/chat"))
    world.platform.emit("/chat", b"hello")
    world.clock.advance(0)
    assert world.frames() == [SampleFrame(9, 777, b"hello")]


def test_samples_that_arrive_together_share_a_write(world: ChannelWorld) -> None:
    world.request(link.Subscribe(number=1, topic="/chat"))
    world.platform.emit("/chat", *(b"%d" % number for number in range(50)))
    assert len(world.writer.writes) == 1
    assert len(world.frames()) == 50


def test_unknown_topic_fails_with_the_reason(world: ChannelWorld) -> None:
    answer = world.request(link.Subscribe(number=3, topic="/nope"))
    assert isinstance(answer, link.Failed)
    assert (answer.request, answer.reference) == ("subscribe", "3")
    assert "/nope" in answer.reason


def test_second_subscribe_changes_the_throttle(world: ChannelWorld) -> None:
    world.request(link.Subscribe(number=1, topic="/chat"))
    world.request(link.Subscribe(number=1, topic="/chat", throttle_ms=1000))
    assert len(world.platform.subscriptions) == 1
    world.platform.emit("/chat", b"a")
    world.platform.emit("/chat", b"b")
    world.clock.advance(0)
    assert [each.body for each in world.frames()] == [b"a"] or world.frames() == []
    world.clock.advance(1.0)
    assert world.frames()[-1].body == b"b"


def test_full_transport_keeps_the_newest_sample(world: ChannelWorld) -> None:
    world.request(link.Subscribe(number=1, topic="/chat"))
    world.channel.pause()
    for number in range(4):
        world.platform.emit("/chat", bytes([number]) * 300_000)
        world.clock.advance(0.01)
    assert world.writer.writes == []
    world.channel.resume()
    world.run(0.1)
    assert [each.body[0] for each in world.frames()] == [3]
    assert world.channel.sample_queue.dropped == 3


def test_the_relay_is_told_of_samples_that_were_dropped_before_the_queue(world: ChannelWorld) -> None:
    world.request(link.Subscribe(number=1, topic="/chat"))
    (subscription,) = world.platform.subscriptions
    for _ in range(2):
        subscription.on_dropped(3)
    world.run(1.1)
    (loss,) = [each for each in world.writer.sent if isinstance(each, link.SamplesDropped)]
    assert (loss.number, loss.reason, loss.count) == (1, "slow_robot", 6)
    assert world.channel.sample_queue.dropped == 0, "it is counted where it was dropped"


def test_answers_pass_a_full_transport(world: ChannelWorld) -> None:
    world.channel.pause()
    assert isinstance(world.request(link.Subscribe(number=1, topic="/chat")), link.Subscribed)


def test_change_of_publishers_is_reported(world: ChannelWorld) -> None:
    """By another confirmation."""
    world.request(link.Subscribe(number=1, topic="/chat"))
    source = world.platform.subscriptions[0]
    source.latched = True
    source.on_change()
    assert world.writer.sent[-1].latched is True


def test_advertised_reports_motion_topics(world: ChannelWorld) -> None:
    assert world.request(link.Advertise(number=5, topic="/cmd_vel", type=TWIST)).motion is True
    assert world.request(link.Advertise(number=6, topic="/chat", type=STRING)).motion is False


@pytest.mark.parametrize(
    ("topic", "type"),
    [
        ("/cmd_vel", "geometry_msgs/Twist"),
        ("cmd_vel", TWIST),
        ("/base", ""),
        ("/arm", STRING),
        ("arm", "std_msgs/String"),
    ],
)
def test_motion_topics_are_recognised_in_every_spelling(topic: str, type: str) -> None:
    world = ChannelWorld()
    world.motion.policy = MotionPolicy(types=[TWIST], topics=["/arm"])
    world.platform.view = GraphView(topics={"/base": link.Topic(types=[TWIST])})
    assert world.request(link.Advertise(number=5, topic=topic, type=type)).motion is True


def test_motion_has_its_own_quality_of_service(world: ChannelWorld) -> None:
    """On other topics the client's request counts."""
    wish = link.QoS(history="keep_all", durability="transient_local", reliability="best_effort")
    world.request(link.Advertise(number=5, topic="/cmd_vel", type=TWIST, latch=True, qos=wish, queue_size=9))
    world.request(link.Advertise(number=6, topic="/chat", type=STRING, latch=True, qos=wish, queue_size=3))
    motion, chat = world.platform.publishers
    assert (motion.latch, motion.qos, motion.queue_size) == (False, MOTION_QOS, 0)
    assert (chat.latch, chat.qos, chat.queue_size) == (True, wish, 3)


def test_too_many_motion_topics_are_refused_with_the_reason(world: ChannelWorld) -> None:
    """While all others move; no publisher remains."""
    for number in range(MAX_TOPICS):
        world.request(link.Advertise(number=number, topic=f"/t{number}", type=TWIST))
        world.channel.publish(CommandFrame(number, world.now(), DRIVER, twist(1.0)))
    answer = world.request(link.Advertise(number=99, topic="/more", type=TWIST))
    assert isinstance(answer, link.Failed)
    assert str(MAX_TOPICS) in answer.reason
    assert len(world.platform.publishers) == MAX_TOPICS


def test_commands_from_before_an_advertisement_are_never_executed(world: ChannelWorld) -> None:
    """Nor those between two advertisements."""
    world.command(twist(1.0))
    world.request(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    world.channel.handle(link.Unadvertise(number=5))
    world.command(twist(1.0))
    world.request(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    world.run(1)
    assert world.platform.published == []


def test_other_topics_have_no_deadline(world: ChannelWorld) -> None:
    world.request(link.Advertise(number=6, topic="/chat", type=STRING))
    world.channel.publish(SampleFrame(6, 0, b"old"))
    assert world.platform.published == [("/chat", b"old")]


def test_samples_of_unknown_publications_are_ignored(world: ChannelWorld) -> None:
    world.channel.publish(SampleFrame(6, world.now(), b"x"))
    assert world.platform.published == []


def test_unadvertise_stops_the_robot(world: ChannelWorld) -> None:
    world.request(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    world.command(twist(1.0))
    world.channel.handle(link.Unadvertise(number=5))
    assert world.platform.published == [("/cmd_vel", twist(1.0)), ("/cmd_vel", twist())]
    world.run(0.2)
    assert world.platform.published == [("/cmd_vel", twist(1.0))] + 5 * [("/cmd_vel", twist())]
    assert world.platform.publishers == []


def test_end_of_the_channel_stops_the_robot_and_releases_everything(world: ChannelWorld) -> None:
    world.platform.services["/slow"] = lambda request: Deferred()
    world.request(link.Subscribe(number=1, topic="/chat", throttle_ms=1000))
    world.platform.emit("/chat", b"a")
    world.platform.emit("/chat", b"b")
    world.request(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    world.request(link.CallService(id="x", service="/slow", type="t", timeout=5, cdr=""))
    world.command(twist(1.0))
    sent_before = len(world.writer.sent)
    world.channel.close()
    assert world.platform.published[-1] == ("/cmd_vel", twist())
    world.run(0.2)
    assert (world.platform.subscriptions, world.platform.publishers) == ([], [])
    world.clock.advance(IDLE_TOPIC_SECONDS)
    assert world.clock.getDelayedCalls() == []
    assert len(world.writer.sent) == sent_before


def test_failure_to_release_one_part_does_not_affect_the_others(
    world: ChannelWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    given_up: list[Deferred[bytes]] = []
    world.platform.services["/slow"] = lambda request: Deferred(given_up.append)
    world.platform.actions.add("/navigate_to_pose")
    for request in (
        link.Subscribe(number=1, topic="/chat"),
        link.Advertise(number=4, topic="/chat", type=STRING),
        link.Advertise(number=5, topic="/cmd_vel", type=TWIST),
        link.AdvertiseService(service="/mine", type="std_srvs/srv/Trigger"),
        link.CallService(id="x", service="/slow", type="t", timeout=5, cdr=""),
        link.SendActionGoal(
            id="g", action="/navigate_to_pose", type="t", source=DRIVER, stamp=world.now(), cdr=""
        ),
    ):
        world.channel.handle(request)
    world.command(twist(1.0))
    platform = world.platform
    for each in (platform.subscriptions[0], platform.publishers[0], platform.advertised_services["/mine"]):
        monkeypatch.setattr(each, "close", broken)
    world.channel.close()
    assert [goal.cancelled for goal in platform.goals] == [True]
    assert platform.published[-1] == ("/cmd_vel", twist())
    assert len(given_up) == 1


def test_call_is_answered(world: ChannelWorld) -> None:
    world.platform.services["/echo"] = lambda request: request
    answer = world.request(
        link.CallService(id="7", service="/echo", type="t", timeout=5, cdr=link.to_base64(b"abc"))
    )
    assert answer == link.ServiceResponse(id="7", result=True, cdr=link.to_base64(b"abc"))


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (link.CallService(id="7", service="/none", type="t", timeout=5, cdr=""), "no service /none"),
        (link.CallService(id="7", service="/echo", type="t", timeout=5), "CDR"),
        (link.CallService(id="7", service="/echo", type="t", timeout=5, cdr="%%"), "base64"),
    ],
)
def test_call_that_can_not_be_made_is_answered_with_the_reason(
    world: ChannelWorld, message: link.CallService, words: str
) -> None:
    world.platform.services["/echo"] = lambda request: request
    answer = world.request(message)
    assert isinstance(answer, link.ServiceResponse)
    assert answer.result is False
    assert words in answer.reason


def test_unexpected_error_of_the_platform_is_one_failed_request(
    world: ChannelWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The answer has no internals, and the channel stays open."""
    monkeypatch.setattr(world.platform, "subscribe", broken)
    answer = world.request(link.Subscribe(number=1, topic="/chat"))
    assert isinstance(answer, link.Failed)
    assert "secret" not in answer.reason


def test_type_definition_is_sent_or_fails_by_name(world: ChannelWorld) -> None:
    world.platform.definitions[STRING] = "string data\n"
    assert world.request(link.GetType(type=STRING)) == link.TypeDefinition(type=STRING, text="string data\n")
    answer = world.request(link.GetType(type="a/msg/B"))
    assert (answer.request, answer.reference) == ("get_type", "a/msg/B")


def test_interfaces_are_reported(world: ChannelWorld) -> None:
    """Sorted."""
    world.platform.definitions = {"b/msg/B": "", "a/srv/A": ""}
    assert world.request(link.GetInterfaces()) == link.Interfaces(types=["a/srv/A", "b/msg/B"])


def test_every_request_of_the_protocol_has_a_handler(world: ChannelWorld) -> None:
    handled_by_link = {link.Ping, link.Pong, link.Bye}
    assert set(world.channel._handlers) == set(get_args(link.RelayChannel)) - handled_by_link


@pytest.mark.parametrize("source", [0, DRIVER + 1])
def test_motion_calls_and_goals_need_control(world: ChannelWorld, source: int) -> None:
    """In every spelling, and by the hidden service of an action."""
    echo = {
        "/arm/move",
        "/lamp",
        "/navigate_to_pose/_action/send_goal",
        "/navigate_to_pose/_action/cancel_goal",
    }
    for service in echo:
        world.platform.services[service] = lambda request: request
    world.platform.actions = {"/navigate_to_pose", "/dock"}
    cdr = link.to_base64(b"abc")

    def call(service: str, by: int) -> bool:
        answer = world.request(link.CallService(id="c", service=service, type="t", source=by, cdr=cdr))
        return bool(answer.result)

    def goal(action: str, by: int) -> bool:
        before = len(world.platform.goals)
        world.request(link.SendActionGoal(id=f"{action}{by}", action=action, type="t", source=by, cdr=cdr))
        return len(world.platform.goals) > before

    for name in ("/arm/move", "arm/move", "/navigate_to_pose/_action/send_goal"):
        assert not call(name, source)
    assert call("/arm/move", DRIVER)
    assert call("/navigate_to_pose/_action/send_goal", DRIVER)
    assert call("/lamp", source)
    assert call("/navigate_to_pose/_action/cancel_goal", source)
    for name in ("/navigate_to_pose", "navigate_to_pose"):
        assert not goal(name, source)
    assert goal("/navigate_to_pose", DRIVER)
    assert goal("/dock", source)
    assert world.authority.refused == 5


def test_only_the_holders_commands_are_obeyed(world: ChannelWorld) -> None:
    world.request(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    world.command(twist(0.5), DRIVER + 1)
    world.command(twist(1.0))
    assert world.platform.published == [("/cmd_vel", twist(1.0))]


def test_failure_to_cancel_one_goal_does_not_affect_the_next(
    world: ChannelWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.platform.actions = {"/a", "/navigate_to_pose"}
    for action in ("/a", "/navigate_to_pose"):
        world.request(link.SendActionGoal(id=action, action=action, type="t", source=DRIVER, cdr=""))
    first, second = world.platform.goals
    monkeypatch.setattr(first, "cancel", broken)
    world.channel.cancel_goals(only_moving=False)
    assert second.cancelled
    second.result.callback(GoalOutcome(CANCELED, None, "stopped"))
    assert world.writer.sent[-1] == link.ActionResult(
        id="/navigate_to_pose", status=CANCELED, result=False, reason="stopped"
    )


def test_samples_to_motion_topics_are_dropped_and_counted(world: ChannelWorld) -> None:
    """They name no source."""
    world.request(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    world.channel.publish(SampleFrame(5, world.now(), twist(1.0)))
    assert world.platform.published == []
    assert world.authority.refused == 1


# --- what publishers keep -----------------------------------------------------------------------------------


def latched(world: ChannelWorld, **fields: object) -> MemorySubscription:
    """A latched topic that is subscribed as number 1; three of its samples were sent."""
    world.request(link.Subscribe(number=1, topic="/chat", **fields))
    (source,) = world.platform.subscriptions
    source.latched, source.stamps_id = True, "memory"
    source.on_change()
    for stamp, body in ((10, b"aaaa"), (11, b"bbbb"), (12, b"cccc")):
        source.stamp = stamp
        world.platform.emit("/chat", body)
    return source


def test_latched_samples_are_repeated_by_their_stamps(world: ChannelWorld) -> None:
    """With bodies only where the relay has none; stamp 0 without a body ends them."""
    source = latched(world)
    assert world.writer.sent[-1].replays == "memory"
    world.clock.advance(0)
    assert [each.stamp for each in world.frames()] == [10, 11, 12]
    source.kept_samples = {11: b"bbbb", 12: b"cccc"}
    world.request(link.Subscribe(number=1, topic="/chat", known_stamps=[10, 11]))
    source.request_ends[0]()
    assert world.frames()[3:] == [
        SampleFrame(1, 11, b""),
        SampleFrame(1, 12, b"cccc"),
        SampleFrame(1, 0, b""),
    ]


def test_repeated_latched_samples_pass_throttle_and_full_transport(world: ChannelWorld) -> None:
    source = latched(world, throttle_ms=60_000)
    source.kept_samples = {10: b"aaaa", 11: b"bbbb", 12: b"cccc"}
    world.channel.pause()
    world.request(link.Subscribe(number=1, topic="/chat", throttle_ms=60_000, known_stamps=[]))
    world.clock.advance(30)
    world.channel.resume()
    world.run(0.1)
    assert {each.body for each in world.frames()} == {b"aaaa", b"bbbb", b"cccc"}


def test_latched_samples_of_all_publishers_pass_a_full_transport(world: ChannelWorld) -> None:
    """Each publisher has sent one, and none is sent again."""
    source = latched(world)
    source.publishers = 10
    source.on_change()
    world.clock.advance(0)
    world.channel.pause()
    for number in range(10):
        source.stamp = 20 + number
        world.platform.emit("/chat", bytes([number]) * 500_000)
        world.clock.advance(0.3)
    world.channel.resume()
    world.run(2)
    assert [each.body[0] for each in world.frames()[3:]] == list(range(10))
    assert not [each for each in world.writer.sent if isinstance(each, link.SamplesDropped)]


def test_inhibited_topics_repeat_no_new_samples(world: ChannelWorld) -> None:
    """The end is sent in any case."""
    source = latched(world)
    source.kept_samples = {12: b"cccc", 13: b"dddd"}
    for hold, stamps in ((False, [0]), (True, [12, 0])):
        world.clock.advance(0)
        before = len(world.frames())
        world.inhibited["/chat"] = hold
        world.channel.update_inhibition("/chat")
        world.request(link.Subscribe(number=1, topic="/chat", known_stamps=[12]))
        source.request_ends.pop()()
        assert [(each.stamp, each.body) for each in world.frames()[before:]] == [
            (each, b"") for each in stamps
        ]


def test_failed_request_for_latched_samples_is_ended(world: ChannelWorld) -> None:
    """The subscription stays."""
    source = latched(world)

    def broken_request(*_: object) -> None:
        raise RuntimeError("out of memory")

    source.request_latched = broken_request  # type: ignore[method-assign]
    answer = world.request(link.Subscribe(number=1, topic="/chat", known_stamps=[10]))
    assert isinstance(answer, link.Subscribed)
    world.clock.advance(0)
    assert world.frames()[-1] == SampleFrame(1, 0, b"")


def test_unmatched_nodes_are_reported(world: ChannelWorld) -> None:
    """Of subscriptions, publications and motion topics."""
    world.request(link.Subscribe(number=1, topic="/chat"))
    world.request(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    world.request(link.Advertise(number=6, topic="/chat", type=STRING))
    (source,) = world.platform.subscriptions
    motion, chat = world.platform.publishers
    for number, end, motion_too in ((1, source, False), (5, motion, True), (6, chat, False)):
        end.unmatched = ["/odd: its reason"]
        end.on_change()
        said = world.writer.sent[-1]
        assert (said.number, said.unmatched) == (number, ["/odd: its reason"])
        assert getattr(said, "motion", False) is motion_too
    world.channel.handle(link.Unadvertise(number=6))
    count = len(world.writer.sent)
    chat.on_change()
    assert len(world.writer.sent) == count
