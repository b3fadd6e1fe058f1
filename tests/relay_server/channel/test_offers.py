"""Services and actions of clients in the robot's graph: each name once, asked for again when the robot is back."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.rights import Grant, Level, Rules
from relay_server.channels import advertisements as module
from relay_server.channels import robot_link
from tests.relay_server.memory import ADD, FIBONACCI, GRAPH, Person, World

KINDS = ["service", "action"]
TYPES = {"service": ADD, "action": FIBONACCI}
ASKED: dict[str, Any] = {"service": link.AdvertiseService, "action": link.AdvertiseAction}
ENDED: dict[str, Any] = {"service": link.UnadvertiseService, "action": link.UnadvertiseAction}


def offer(person: Person, kind: str, name: str = "/mine", type_name: str = "") -> None:
    """A client offers something."""
    person.says(f"advertise_{kind}", **{kind: name}, type=type_name or TYPES[kind])


def confirm(world: World, kind: str, name: str = "/mine") -> None:
    """The robot offers it."""
    told = {"service": link.AdvertisedService, "action": link.AdvertisedAction}[kind]
    world.channel.message(told(**{kind: name}, type=TYPES[kind]))


@pytest.mark.parametrize("kind", KINDS)
def test_the_robot_is_asked_to_offer_it(world: World, kind: str) -> None:
    """With the full name and type, and who offers it; the same again asks nothing; the end is told."""
    person = world.at_work()
    short = TYPES[kind].replace(f"/{'srv' if kind == 'service' else 'action'}/", "/")
    offer(person, kind, "mine", short)
    offer(person, kind, "/mine")
    (asked,) = world.link.all(ASKED[kind])
    assert (getattr(asked, kind), asked.type, asked.source) == ("/mine", TYPES[kind], "ann")
    assert world.link.all(link.GetType) == [link.GetType(type=TYPES[kind])]
    confirm(world, kind)
    person.says(f"unadvertise_{kind}", **{kind: "mine"})
    assert [getattr(each, kind) for each in world.link.all(ENDED[kind])] == ["/mine"]
    assert not person.told()
    assert world.channel.wire.names == 0


@pytest.mark.parametrize("kind", KINDS)
def test_a_name_is_offered_once(world: World, kind: str) -> None:
    """Neither another client, nor the same one with another type, nor what the robot offers itself."""
    person = world.at_work()
    other = world.person()
    other.says("set_level", level="error")
    offer(person, kind)
    offer(other, kind)
    assert other.told() == [f"another client offers the {kind} /mine already"]
    offer(person, kind, type_name={"service": "std_srvs/srv/Empty", "action": "a_msgs/action/Other"}[kind])
    assert person.told() == [f"you offer the {kind} /mine already"]
    world.robot.graph.actions["/walk"] = link.Service(types=[FIBONACCI], providers=["/legs"])
    taken = {"service": "/reset", "action": "/walk"}[kind]
    offer(person, kind, taken)
    assert person.told() == [f"the robot offers the {kind} {taken} itself"]
    other.says(f"unadvertise_{kind}", **{kind: "/mine"})
    assert other.told() == [f"you do not offer the {kind} /mine"]
    assert len(world.link.all(ASKED[kind])) == 1


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["/relay/ping", "relay", "/rosapi/topics", "/rosapi"])
def test_the_relays_own_names_are_refused(world: World, kind: str, name: str) -> None:
    """Nobody speaks for the relay."""
    person = world.at_work()
    offer(person, kind, name)
    assert "are the relay's own" in person.told()[0]
    assert not world.link.all(ASKED[kind])


@pytest.mark.parametrize("kind", KINDS)
def test_the_hidden_parts_of_actions_are_refused(world: World, kind: str) -> None:
    """Whoever offers them would speak for the action."""
    person = world.at_work()
    offer(person, kind, "/walk/_action/send_goal")
    assert "for the parts of actions" in person.told()[0]
    assert not world.link.all(ASKED[kind])


@pytest.mark.parametrize("kind", KINDS)
def test_offering_is_judged(world: World, kind: str) -> None:
    """By the right to provide, by name."""
    world.at_work()
    for rights, reason in (
        ({"level": Level.VIEWER}, "provide on /mine needs the level operator"),
        ({"level": Level.OWNER, "deny": ("provide:/mine",)}, "denied"),
    ):
        person = world.person(**rights)  # type: ignore[arg-type]
        person.says("set_level", level="error")
        offer(person, kind)
        assert reason in person.told()[0]
    assert not world.link.all(ASKED[kind])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("type_name", ["", "no type", "a/b/c/d"])
def test_an_offer_needs_a_type(world: World, kind: str, type_name: str) -> None:
    """One that is a name of a type."""
    person = world.at_work()
    person.says(f"advertise_{kind}", **{kind: "/mine"}, type=type_name)
    assert "type" in person.told()[0]
    assert not world.link.all(ASKED[kind])


@pytest.mark.parametrize("kind", KINDS)
def test_offers_are_made_again_when_the_robot_is_back(world: World, kind: str) -> None:
    """Also those made while it was away; those withdrawn meanwhile are not."""
    person = world.at_work()
    offer(person, kind)
    offer(person, kind, "/second")
    confirm(world, kind)
    world.robot_goes()
    offer(person, kind, "/third")
    person.says(f"unadvertise_{kind}", **{kind: "/second"})
    world.robot_comes()
    world.robot_joins()
    assert [getattr(each, kind) for each in world.link.all(ASKED[kind])] == ["/mine", "/third"]


@pytest.mark.parametrize("kind", KINDS)
def test_offers_of_a_client_that_leaves_end(world: World, kind: str) -> None:
    """Others' stay, and the name is free again."""
    person, other = world.at_work(), world.person()
    offer(person, kind)
    offer(other, kind, "/other")
    confirm(world, kind)
    person.session.end()
    assert [getattr(each, kind) for each in world.link.all(ENDED[kind])] == ["/mine"]
    world.link.said.clear()
    offer(other, kind)
    assert [getattr(each, kind) for each in world.link.all(ASKED[kind])] == ["/mine"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_lost_right_ends_offers_at_once(world: World, kind: str) -> None:
    """By name; the client is told."""
    person = world.at_work()
    offer(person, kind)
    offer(person, kind, "/second")
    confirm(world, kind)
    confirm(world, kind, "/second")
    person.session.permit.rules = Rules([Grant(Level.OPERATOR, (), ("provide:/mine",))])
    person.session.permit.on_change()
    assert [getattr(each, kind) for each in world.link.all(ENDED[kind])] == ["/mine"]
    assert person.told()[0].startswith("unadvertised /mine: ")


@pytest.mark.parametrize("kind", KINDS)
def test_what_the_robot_can_not_offer_is_told_and_tried_again(world: World, kind: str) -> None:
    """When its graph changes; the same reason is told once."""
    person = world.at_work()
    offer(person, kind)
    failed = link.Failed(what=f"advertise_{kind}", ref="/mine", reason="another node offers it")
    world.channel.message(failed)
    assert person.told() == [f"advertise_{kind} /mine: another node offers it"]
    world.registry.graph(world.robot, GRAPH)
    world.channel.message(failed)
    assert not person.told()
    world.registry.graph(world.robot, GRAPH)
    assert len(world.link.take(ASKED[kind])) == 3
    confirm(world, kind)
    world.registry.graph(world.robot, GRAPH)
    assert not world.link.all(ASKED[kind])


def appear(world: World, kind: str, name: str = "/mine") -> None:
    """A node of the robot offers it."""
    provided = {name: link.Service(types=[TYPES[kind]], providers=["/base"])}
    world.registry.graph(world.robot, link.Graph(**{f"{kind}s": provided}))


@pytest.mark.parametrize("kind", KINDS)
def test_an_offer_gives_way_to_the_robots_own(world: World, kind: str) -> None:
    """Nobody is answered by a client that was there first; when the robot's is gone it is offered again."""
    person = world.at_work()
    offer(person, kind)
    world.define()
    confirm(world, kind)
    ask(world.person(), kind)
    ask(person, kind, 2)
    assert len([each for each in person.client.take() if each["op"] in REQUESTS]) == 2
    appear(world, kind)
    told = person.client.take()
    assert next(each["msg"] for each in told if each["op"] == "status") == (
        f"advertise_{kind} /mine: the robot offers the {kind} /mine itself"
    )
    assert [each["id"] for each in told if each["op"] in ANSWERS] == [2]
    assert [getattr(each, kind) for each in world.link.take(ENDED[kind])] == ["/mine"]
    ask(person, kind, 3)
    assert len(world.link.all(link.CallService) + world.link.all(link.SendActionGoal)) == 1
    assert not [each for each in person.client.take() if each["op"] in REQUESTS]
    world.link.take(ASKED[kind])
    world.registry.graph(world.robot, link.Graph(**{f"{kind}s": {"/mine": None}}))
    assert len(world.link.all(ASKED[kind])) == 1


@pytest.mark.parametrize("kind", KINDS)
def test_what_the_robot_has_when_it_comes_is_not_offered(world: World, kind: str) -> None:
    """Whoever waited for it with an offer of that name."""
    person = world.person()
    person.says("set_level", level="error")
    offer(person, kind)
    world.robot_comes()
    appear(world, kind)
    world.robot_joins()
    assert not world.link.all(ASKED[kind])
    assert person.told() == [f"advertise_{kind} /mine: the robot offers the {kind} /mine itself"]


REQUESTS = ("call_service", "send_action_goal")
ANSWERS = ("service_response", "action_result")


def ask(person: Person, kind: str, id: int = 1) -> None:
    """Somebody wants it done."""
    if kind == "service":
        person.says("call_service", service="/mine", id=id, args={"a": 1, "b": 2})
    else:
        person.says("send_action_goal", action="/mine", id=id, args={"order": 3})


@pytest.mark.parametrize("kind", KINDS)
def test_an_answer_to_a_former_offer_is_not_taken_for_the_new_one(world: World, kind: str) -> None:
    """The robot answers in order: what is asked of a name waits for the answer to what was asked before."""
    person, other = world.at_work(), world.person()
    other.says("set_level", level="error")
    offer(person, kind)
    person.says(f"unadvertise_{kind}", **{kind: "/mine"})
    offer(other, kind)
    assert len(world.link.all(ASKED[kind])) == 1
    world.channel.message(link.Failed(what=f"advertise_{kind}", ref="/mine", reason="no such type"))
    assert not other.told()
    assert len(world.link.all(ASKED[kind])) == 2


@pytest.mark.parametrize("kind", KINDS)
def test_offers_of_one_client_and_of_one_user_are_bounded(
    world: World, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over all connections of a user; and so are all names in use on a robot."""
    monkeypatch.setattr(module, "OFFERS", 2)
    monkeypatch.setattr(module, "USER_OFFERS", 3)
    person = world.at_work()
    again, stranger = world.person(), world.person(user=8)
    for each in (again, stranger):
        each.says("set_level", level="error")
    for number in range(3):
        offer(person, kind, f"/a{number}")
    assert person.told() == [f"at most 2 {kind}s can be offered on one connection"]
    for number in range(2):
        offer(again, kind, f"/b{number}")
    assert again.told() == [f"you offer 3 {kind}s on this robot, the most one user may"]
    monkeypatch.setattr(robot_link, "NAMES", 4)
    for number in range(2):
        offer(stranger, kind, f"/c{number}")
    assert stranger.told() == ["more than 4 names are in use on this robot"]


@pytest.mark.parametrize("kind", KINDS)
def test_no_client_floods_the_robot_with_offers(
    world: World, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bounded number of requests goes out at a time; the next when one is answered."""
    monkeypatch.setattr(robot_link, "ASKS", 4)
    person = world.at_work()
    for number in range(20):
        offer(person, kind, f"/a{number}")
    assert len(world.link.all(ASKED[kind])) == 4
    confirm(world, kind, "/a0")
    assert len(world.link.all(ASKED[kind])) == 5


def test_changing_offers_in_a_hurry_is_refused(world: World) -> None:
    """As for topics."""
    person = world.at_work()
    for _ in range(600):
        offer(person, "service")
        person.says("unadvertise_service", service="/mine")
    assert any("too many changes at once" in each for each in person.told())
    assert len(world.link.all(link.AdvertiseService)) == 1


def test_a_channel_that_is_closed_offers_nothing(world: World) -> None:
    """Whoever is still there."""
    person = world.at_work()
    offer(person, "service")
    world.channel.shut()
    assert world.channels.find(world.robot) is None
    assert not person.session.channel.services._offers
