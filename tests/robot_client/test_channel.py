"""A channel's requests, samples and end."""

from __future__ import annotations

from typing import get_args

import pytest
from twisted.internet.defer import Deferred

from relay_protocol import link
from relay_protocol.frames import CommandFrame, SampleFrame
from relay_protocol.link import MotionPolicy
from robot_client.motion.motion import KEPT, MOTION_QOS
from robot_client.motion.motion_topics import MAX_TOPICS
from robot_client.platforms.base import CANCELED, GoalOutcome, GraphView
from robot_client.platforms.memory import TWIST, MemorySource, twist
from tests.robot_client.breaking import broken
from tests.robot_client.scene import DRIVER, STRING, Scene


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_subscribe_is_confirmed_with_type_and_encoding(scene: Scene) -> None:
    """A subscription without a type takes it from the graph and says so."""
    answer = scene.ask(link.Subscribe(number=1, topic="/chat"))
    assert answer == link.Subscribed(number=1, topic="/chat", type=STRING, encoding="cdr", publishers=1)


def test_samples_carry_number_and_wall_clock(scene: Scene) -> None:
    """A sample goes out as a frame of its subscription with the robot's wall clock."""
    scene.ask(link.Subscribe(number=9, topic="/chat"))
    scene.platform.emit("/chat", b"hello")
    scene.clock.advance(0)
    assert scene.frames() == [SampleFrame(9, 777, b"hello")]


def test_samples_that_come_together_share_a_write(scene: Scene) -> None:
    """What comes together is one write."""
    scene.ask(link.Subscribe(number=1, topic="/chat"))
    scene.platform.emit("/chat", *(b"%d" % number for number in range(50)))
    assert len(scene.wire.writes) == 1
    assert len(scene.frames()) == 50


def test_unknown_topic_fails_in_words(scene: Scene) -> None:
    """A topic without a type that the graph does not know fails with its number."""
    answer = scene.ask(link.Subscribe(number=3, topic="/nope"))
    assert isinstance(answer, link.Failed)
    assert (answer.what, answer.ref) == ("subscribe", "3")
    assert "/nope" in answer.reason


def test_second_subscribe_changes_the_throttle(scene: Scene) -> None:
    """The same number again changes the throttle and makes no second subscription."""
    scene.ask(link.Subscribe(number=1, topic="/chat"))
    scene.ask(link.Subscribe(number=1, topic="/chat", throttle_ms=1000))
    assert len(scene.platform.sources) == 1
    scene.platform.emit("/chat", b"a")
    scene.platform.emit("/chat", b"b")
    scene.clock.advance(0)
    assert [each.body for each in scene.frames()] == [b"a"] or scene.frames() == []
    scene.clock.advance(1.0)
    assert scene.frames()[-1].body == b"b"


def test_full_transport_keeps_the_newest(scene: Scene) -> None:
    """While the transport is full nothing is written; with room again the newest comes."""
    scene.ask(link.Subscribe(number=1, topic="/chat"))
    scene.channel.pause()
    for number in range(4):
        scene.platform.emit("/chat", bytes([number]) * 300_000)
        scene.clock.advance(0.01)
    assert scene.wire.writes == []
    scene.channel.resume()
    scene.run(0.1)
    assert [each.body[0] for each in scene.frames()] == [3]
    assert scene.channel.uplink.dropped == 3


def test_answers_pass_a_full_transport(scene: Scene) -> None:
    """What the relay asked is answered however full the transport is."""
    scene.channel.pause()
    assert isinstance(scene.ask(link.Subscribe(number=1, topic="/chat")), link.Subscribed)


def test_change_of_publishers_is_told(scene: Scene) -> None:
    """When publishers become latching, the relay hears of it by another confirmation."""
    scene.ask(link.Subscribe(number=1, topic="/chat"))
    source = scene.platform.sources[0]
    source.latched = True
    source.on_change()
    assert scene.wire.said[-1].latched is True


def test_advertise_says_what_is_motion(scene: Scene) -> None:
    """The relay learns which publications the robot counts as motion."""
    assert scene.ask(link.Advertise(number=5, topic="/cmd_vel", type=TWIST)).motion is True
    assert scene.ask(link.Advertise(number=6, topic="/chat", type=STRING)).motion is False


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
def test_no_spelling_leads_past_the_watchdog(topic: str, type: str) -> None:
    """What moves the robot is told by the names the platform uses, however the relay spells them."""
    scene = Scene()
    scene.desk.policy = MotionPolicy(types=[TWIST], topics=["/arm"])
    scene.platform.view = GraphView(topics={"/base": link.Topic(types=[TWIST])})
    assert scene.ask(link.Advertise(number=5, topic=topic, type=type)).motion is True


def test_client_has_no_say_in_how_motion_is_published(scene: Scene) -> None:
    """Motion is reliable, volatile and short, whatever was asked; elsewhere the client is asked."""
    wish = link.QoS(history="keep_all", durability="transient_local", reliability="best_effort")
    scene.ask(link.Advertise(number=5, topic="/cmd_vel", type=TWIST, latch=True, qos=wish, queue_size=9))
    scene.ask(link.Advertise(number=6, topic="/chat", type=STRING, latch=True, qos=wish, queue_size=3))
    motion, chat = scene.platform.sinks
    assert (motion.latch, motion.qos, motion.queue_size) == (False, MOTION_QOS, 0)
    assert (chat.latch, chat.qos, chat.queue_size) == (True, wish, 3)


def test_too_many_motion_topics_are_refused_in_words(scene: Scene) -> None:
    """The one over the limit, while all others move: with the reason, and no publisher is left of it."""
    for number in range(MAX_TOPICS):
        scene.ask(link.Advertise(number=number, topic=f"/t{number}", type=TWIST))
        scene.channel.command(CommandFrame(number, scene.now(), DRIVER, twist(1.0)))
    answer = scene.ask(link.Advertise(number=99, topic="/more", type=TWIST))
    assert isinstance(answer, link.Failed)
    assert str(MAX_TOPICS) in answer.reason
    assert len(scene.platform.sinks) == MAX_TOPICS


def test_commands_from_before_an_advertisement_are_never_executed(scene: Scene) -> None:
    """What comes before the advertisement, or between two of them, is kept nowhere."""
    scene.drive(twist(1.0))
    scene.ask(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    scene.channel.handle(link.Unadvertise(number=5))
    scene.drive(twist(1.0))
    scene.ask(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    scene.run(1)
    assert scene.platform.published == []


def test_plain_topics_are_not_judged_by_age(scene: Scene) -> None:
    """A message on a topic that moves nothing is published however old it is."""
    scene.ask(link.Advertise(number=6, topic="/chat", type=STRING))
    scene.channel.sample(SampleFrame(6, 0, b"old"))
    assert scene.platform.published == [("/chat", b"old")]


def test_samples_of_unknown_numbers_go_nowhere(scene: Scene) -> None:
    """A sample for a publication that is not there is passed over."""
    scene.channel.sample(SampleFrame(6, scene.now(), b"x"))
    assert scene.platform.published == []


def test_unadvertise_stops_the_robot(scene: Scene) -> None:
    """A driver that unadvertises leaves the robot standing, at once."""
    scene.ask(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    scene.drive(twist(1.0))
    scene.channel.handle(link.Unadvertise(number=5))
    assert scene.platform.published == [("/cmd_vel", twist(1.0)), ("/cmd_vel", twist())]
    scene.run(0.2)
    assert scene.platform.published == [("/cmd_vel", twist(1.0))] + 5 * [("/cmd_vel", twist())]
    assert scene.platform.sinks == []


def test_end_of_the_channel_stops_and_releases_all(scene: Scene) -> None:
    """A channel that ends stops the robot, ends its subscriptions and publications, gives up its calls."""
    scene.platform.services["/slow"] = lambda request: Deferred()
    scene.ask(link.Subscribe(number=1, topic="/chat", throttle_ms=1000))
    scene.platform.emit("/chat", b"a")
    scene.platform.emit("/chat", b"b")
    scene.ask(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    scene.ask(link.CallService(id="x", service="/slow", type="t", timeout=5, cdr=""))
    scene.drive(twist(1.0))
    told = len(scene.wire.said)
    scene.channel.close()
    assert scene.platform.published[-1] == ("/cmd_vel", twist())
    scene.run(0.2)
    assert (scene.platform.sources, scene.platform.sinks) == ([], [])
    scene.clock.advance(KEPT)
    assert scene.clock.getDelayedCalls() == []
    assert len(scene.wire.said) == told


def test_what_can_not_be_released_keeps_nothing_else(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the end of a channel whose subscription, publication and offer all fail to go, goals and calls end."""
    given_up: list[Deferred[bytes]] = []
    scene.platform.services["/slow"] = lambda request: Deferred(given_up.append)
    scene.platform.actions.add("/navigate_to_pose")
    for request in (
        link.Subscribe(number=1, topic="/chat"),
        link.Advertise(number=4, topic="/chat", type=STRING),
        link.Advertise(number=5, topic="/cmd_vel", type=TWIST),
        link.AdvertiseService(service="/mine", type="std_srvs/srv/Trigger"),
        link.CallService(id="x", service="/slow", type="t", timeout=5, cdr=""),
        link.SendActionGoal(
            id="g", action="/navigate_to_pose", type="t", source=DRIVER, stamp=scene.now(), cdr=""
        ),
    ):
        scene.channel.handle(request)
    scene.drive(twist(1.0))
    platform = scene.platform
    for each in (platform.sources[0], platform.sinks[0], platform.offered["/mine"]):
        monkeypatch.setattr(each, "close", broken)
    scene.channel.close()
    assert [goal.cancelled for goal in platform.goals] == [True]
    assert platform.published[-1] == ("/cmd_vel", twist())
    assert len(given_up) == 1


def test_call_is_answered(scene: Scene) -> None:
    """A service's answer comes back with the id of its call."""
    scene.platform.services["/echo"] = lambda request: request
    answer = scene.ask(
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
def test_call_that_can_not_be_made_is_answered_in_words(
    scene: Scene, message: link.CallService, words: str
) -> None:
    """A call that fails is answered with false and the reason."""
    scene.platform.services["/echo"] = lambda request: request
    answer = scene.ask(message)
    assert isinstance(answer, link.ServiceResponse)
    assert answer.result is False
    assert words in answer.reason


def test_middleware_that_throws_costs_one_answer(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """An unforeseen fault of the platform is answered without its internals, and the channel lives."""
    monkeypatch.setattr(scene.platform, "subscribe", broken)
    answer = scene.ask(link.Subscribe(number=1, topic="/chat"))
    assert isinstance(answer, link.Failed)
    assert "secret" not in answer.reason


def test_type_definition_or_words(scene: Scene) -> None:
    """A known type is sent, an unknown one fails by its name."""
    scene.platform.definitions[STRING] = "string data\n"
    assert scene.ask(link.GetType(type=STRING)) == link.TypeDefinition(type=STRING, text="string data\n")
    answer = scene.ask(link.GetType(type="a/msg/B"))
    assert (answer.what, answer.ref) == ("get_type", "a/msg/B")


def test_interfaces_are_told(scene: Scene) -> None:
    """The names of all types there are come in order."""
    scene.platform.definitions = {"b/msg/B": "", "a/srv/A": ""}
    assert scene.ask(link.GetInterfaces()) == link.Interfaces(types=["a/srv/A", "b/msg/B"])


def test_every_request_of_the_contract_is_known(scene: Scene) -> None:
    """The channel has a handler for all that the relay may ask."""
    told = {link.Ping, link.Pong, link.Bye}
    assert set(scene.channel._handlers) == set(get_args(link.RelayChannel)) - told


@pytest.mark.parametrize("source", [0, DRIVER + 1])
def test_calls_and_goals_that_move_the_robot_are_for_the_holder(scene: Scene, source: int) -> None:
    """Also by a name spelled otherwise, and by the hidden service of an action; everything else is for everybody."""
    echo = {
        "/arm/move",
        "/lamp",
        "/navigate_to_pose/_action/send_goal",
        "/navigate_to_pose/_action/cancel_goal",
    }
    for service in echo:
        scene.platform.services[service] = lambda request: request
    scene.platform.actions = {"/navigate_to_pose", "/dock"}
    cdr = link.to_base64(b"abc")

    def call(service: str, by: int) -> bool:
        answer = scene.ask(link.CallService(id="c", service=service, type="t", source=by, cdr=cdr))
        return bool(answer.result)

    def goal(action: str, by: int) -> bool:
        before = len(scene.platform.goals)
        scene.ask(link.SendActionGoal(id=f"{action}{by}", action=action, type="t", source=by, cdr=cdr))
        return len(scene.platform.goals) > before

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
    assert scene.authority.refused == 5


def test_only_the_holders_commands_are_obeyed(scene: Scene) -> None:
    """What another source says on the same publication goes nowhere."""
    scene.ask(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    scene.drive(twist(0.5), DRIVER + 1)
    scene.drive(twist(1.0))
    assert scene.platform.published == [("/cmd_vel", twist(1.0))]


def test_goals_are_cancelled_in_order_whatever_one_does(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A goal whose end fails does not keep the next from its own; its result is still told."""
    scene.platform.actions = {"/a", "/navigate_to_pose"}
    for action in ("/a", "/navigate_to_pose"):
        scene.ask(link.SendActionGoal(id=action, action=action, type="t", source=DRIVER, cdr=""))
    first, second = scene.platform.goals
    monkeypatch.setattr(first, "cancel", broken)
    scene.channel.cancel_goals(only_moving=False)
    assert second.cancelled
    second.result.callback(GoalOutcome(CANCELED, None, "stopped"))
    assert scene.wire.said[-1] == link.ActionResult(
        id="/navigate_to_pose", status=CANCELED, result=False, reason="stopped"
    )


def test_samples_to_what_moves_the_robot_are_dropped_and_counted(scene: Scene) -> None:
    """They don't say whose they are."""
    scene.ask(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    scene.channel.sample(SampleFrame(5, scene.now(), twist(1.0)))
    assert scene.platform.published == []
    assert scene.authority.refused == 1


# --- what publishers keep -----------------------------------------------------------------------------------


def latched(scene: Scene, **fields: object) -> MemorySource:
    """A latched topic that is subscribed as number 1, and of which three samples have gone to the relay."""
    scene.ask(link.Subscribe(number=1, topic="/chat", **fields))
    (source,) = scene.platform.sources
    source.latched, source.replays = True, "memory"
    source.on_change()
    for stamp, body in ((10, b"aaaa"), (11, b"bbbb"), (12, b"cccc")):
        source.stamp = stamp
        scene.platform.emit("/chat", body)
    return source


def test_what_publishers_keep_is_repeated_by_its_stamps(scene: Scene) -> None:
    """With bodies only where the relay has none; a sample of stamp 0 without a body is the end."""
    source = latched(scene)
    assert scene.wire.said[-1].replays == "memory"
    scene.clock.advance(0)
    assert [each.stamp for each in scene.frames()] == [10, 11, 12]
    source.keeps = {11: b"bbbb", 12: b"cccc"}
    scene.ask(link.Subscribe(number=1, topic="/chat", kept=[10, 11]))
    source.recalls[0]()
    assert scene.frames()[3:] == [
        SampleFrame(1, 11, b""),
        SampleFrame(1, 12, b"cccc"),
        SampleFrame(1, 0, b""),
    ]


def test_no_throttle_and_no_full_transport_loses_what_is_kept(scene: Scene) -> None:
    """It waits as long as it takes; it may be some publisher's only message."""
    source = latched(scene, throttle_ms=60_000)
    source.keeps = {10: b"aaaa", 11: b"bbbb", 12: b"cccc"}
    scene.channel.pause()
    scene.ask(link.Subscribe(number=1, topic="/chat", throttle_ms=60_000, kept=[]))
    scene.clock.advance(30)
    scene.channel.resume()
    scene.run(0.1)
    assert {each.body for each in scene.frames()} == {b"aaaa", b"bbbb", b"cccc"}


def test_muted_topics_repeat_nothing_new(scene: Scene) -> None:
    """Nothing at all, or with the last value held what the relay has already; the end is said in any case."""
    source = latched(scene)
    source.keeps = {12: b"cccc", 13: b"dddd"}
    for hold, told in ((False, [0]), (True, [12, 0])):
        scene.clock.advance(0)
        before = len(scene.frames())
        scene.silent["/chat"] = hold
        scene.channel.silence("/chat")
        scene.ask(link.Subscribe(number=1, topic="/chat", kept=[12]))
        source.recalls.pop()()
        assert [(each.stamp, each.body) for each in scene.frames()[before:]] == [(each, b"") for each in told]


def test_platform_that_can_not_ask_again_says_so(scene: Scene) -> None:
    """The subscription goes on, and the relay waits for nothing."""
    source = latched(scene)

    def broken_recall(*_: object) -> None:
        raise RuntimeError("out of memory")

    source.recall = broken_recall  # type: ignore[method-assign]
    answer = scene.ask(link.Subscribe(number=1, topic="/chat", kept=[10]))
    assert isinstance(answer, link.Subscribed)
    scene.clock.advance(0)
    assert scene.frames()[-1] == SampleFrame(1, 0, b"")


def test_nodes_that_are_not_reached_are_told(scene: Scene) -> None:
    """By another confirmation, of what is published as of what is subscribed; motion too."""
    scene.ask(link.Subscribe(number=1, topic="/chat"))
    scene.ask(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
    scene.ask(link.Advertise(number=6, topic="/chat", type=STRING))
    (source,) = scene.platform.sources
    motion, chat = scene.platform.sinks
    for number, end, motion_too in ((1, source, False), (5, motion, True), (6, chat, False)):
        end.unmatched = ["/odd: its reason"]
        end.on_change()
        said = scene.wire.said[-1]
        assert (said.number, said.unmatched) == (number, ["/odd: its reason"])
        assert getattr(said, "motion", False) is motion_too
    scene.channel.handle(link.Unadvertise(number=6))
    count = len(scene.wire.said)
    chat.on_change()
    assert len(scene.wire.said) == count
