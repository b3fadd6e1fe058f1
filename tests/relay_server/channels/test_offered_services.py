"""Services and actions of clients in the robot's graph: each name is offered once, and again after the robot
reconnects.
"""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.rights import Grant, Level, Rules
from relay_server.channels import link_state, robot_requests
from relay_server.channels import offered_services as module
from tests.worlds.relay import ADD, FIBONACCI, GRAPH, Person, World

KINDS = ["service", "action"]
TYPES = {"service": ADD, "action": FIBONACCI}
ASKED: dict[str, Any] = {"service": link.AdvertiseService, "action": link.AdvertiseAction}
ENDED: dict[str, Any] = {"service": link.UnadvertiseService, "action": link.UnadvertiseAction}


def offer(person: Person, kind: str, name: str = "/mine", type_name: str = "") -> None:
    """A client offers a service or action."""
    person.says(f"advertise_{kind}", **{kind: name}, type=type_name or TYPES[kind])


def confirm(world: World, kind: str, name: str = "/mine") -> None:
    reported = {"service": link.AdvertisedService, "action": link.AdvertisedAction}[kind]
    world.channel.message(reported(**{kind: name}, type=TYPES[kind]))


@pytest.mark.parametrize("kind", KINDS)
def test_the_robot_is_asked_to_offer_it(world: World, kind: str) -> None:
    """The request has the full name and the type. Repeating it asks nothing; the end is reported."""
    person = world.at_work()
    short = TYPES[kind].replace(f"/{'srv' if kind == 'service' else 'action'}/", "/")
    offer(person, kind, "mine", short)
    offer(person, kind, "/mine")
    (asked,) = world.link.all(ASKED[kind])
    assert (getattr(asked, kind), asked.type) == ("/mine", TYPES[kind])
    assert world.link.all(link.GetType) == [link.GetType(type=TYPES[kind])]
    confirm(world, kind)
    person.says(f"unadvertise_{kind}", **{kind: "mine"})
    assert [getattr(each, kind) for each in world.link.all(ENDED[kind])] == ["/mine"]
    assert not person.reported()
    assert world.channel.link_state.names_in_use == 0


@pytest.mark.parametrize("kind", KINDS)
def test_a_name_is_offered_once(world: World, kind: str) -> None:
    """It is refused to another client, with another type, and if the robot offers the name itself."""
    person = world.at_work()
    other = world.person()
    other.says("set_level", level="error")
    offer(person, kind)
    offer(other, kind)
    assert other.reported() == [f"another client offers the {kind} /mine already"]
    offer(person, kind, type_name={"service": "std_srvs/srv/Empty", "action": "a_msgs/action/Other"}[kind])
    assert person.reported() == [f"you offer the {kind} /mine already"]
    world.robot.graph.actions["/walk"] = link.Service(types=[FIBONACCI], providers=["/legs"])
    taken = {"service": "/reset", "action": "/walk"}[kind]
    offer(person, kind, taken)
    assert person.reported() == [f"the robot offers the {kind} {taken} itself"]
    other.says(f"unadvertise_{kind}", **{kind: "/mine"})
    assert other.reported() == [f"you do not offer the {kind} /mine"]
    assert len(world.link.all(ASKED[kind])) == 1


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["/relay/ping", "relay", "/rosapi/topics", "/rosapi"])
def test_the_relays_own_names_are_refused(world: World, kind: str, name: str) -> None:
    """A client must not answer in the name of the relay."""
    person = world.at_work()
    offer(person, kind, name)
    assert "are the relay's own" in person.reported()[0]
    assert not world.link.all(ASKED[kind])


@pytest.mark.parametrize("kind", KINDS)
def test_the_hidden_parts_of_actions_are_refused(world: World, kind: str) -> None:
    """Offering them would allow answers in the action's name."""
    person = world.at_work()
    offer(person, kind, "/walk/_action/send_goal")
    assert "for the parts of actions" in person.reported()[0]
    assert not world.link.all(ASKED[kind])


@pytest.mark.parametrize("kind", KINDS)
def test_offering_is_judged(world: World, kind: str) -> None:
    """The right to provide is checked by name."""
    world.at_work()
    for rights, reason in (
        ({"level": Level.VIEWER}, "provide on /mine needs the level operator"),
        ({"level": Level.OWNER, "deny": ("provide:/mine",)}, "denied"),
    ):
        person = world.person(**rights)  # type: ignore[arg-type]
        person.says("set_level", level="error")
        offer(person, kind)
        assert reason in person.reported()[0]
    assert not world.link.all(ASKED[kind])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("type_name", ["", "no type", "a/b/c/d"])
def test_an_offer_needs_a_type(world: World, kind: str, type_name: str) -> None:
    """It must be a valid type name."""
    person = world.at_work()
    person.says(f"advertise_{kind}", **{kind: "/mine"}, type=type_name)
    assert "type" in person.reported()[0]
    assert not world.link.all(ASKED[kind])


@pytest.mark.parametrize("kind", KINDS)
def test_offers_are_made_again_when_the_robot_is_back(world: World, kind: str) -> None:
    """Offers made while it was away are included, withdrawn ones are not."""
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
    """Offers of others stay, and the name is free again."""
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
    """Rights are checked by name, and the client is notified."""
    person = world.at_work()
    offer(person, kind)
    offer(person, kind, "/second")
    confirm(world, kind)
    confirm(world, kind, "/second")
    person.context.permit.rules = Rules([Grant(Level.OPERATOR, (), ("provide:/mine",))])
    person.context.permit.on_change()
    assert [getattr(each, kind) for each in world.link.all(ENDED[kind])] == ["/mine"]
    assert person.reported()[0].startswith("unadvertised /mine: ")


@pytest.mark.parametrize("kind", KINDS)
def test_failed_offer_is_reported_and_retried(world: World, kind: str) -> None:
    """It is retried when the graph changes; the same reason is reported once."""
    person = world.at_work()
    offer(person, kind)
    failed = link.Failed(request=f"advertise_{kind}", reference="/mine", reason="another node offers it")
    world.channel.message(failed)
    assert person.reported() == [f"advertise_{kind} /mine: another node offers it"]
    world.registry.graph(world.robot, GRAPH)
    world.channel.message(failed)
    assert not person.reported()
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
def test_an_offer_ends_when_the_robot_has_its_own(world: World, kind: str) -> None:
    """The robot's own server answers; the client's is offered again when that one is gone."""
    person = world.at_work()
    offer(person, kind)
    world.define()
    confirm(world, kind)
    ask(world.person(), kind)
    ask(person, kind, 2)
    assert len([each for each in person.client.take() if each["op"] in REQUESTS]) == 2
    appear(world, kind)
    reported = person.client.take()
    assert next(each["msg"] for each in reported if each["op"] == "status") == (
        f"advertise_{kind} /mine: the robot offers the {kind} /mine itself"
    )
    assert [each["id"] for each in reported if each["op"] in ANSWERS] == [2]
    assert [getattr(each, kind) for each in world.link.take(ENDED[kind])] == ["/mine"]
    ask(person, kind, 3)
    assert len(world.link.all(link.CallService) + world.link.all(link.SendActionGoal)) == 1
    assert not [each for each in person.client.take() if each["op"] in REQUESTS]
    world.link.take(ASKED[kind])
    world.registry.graph(world.robot, link.Graph(**{f"{kind}s": {"/mine": None}}))
    assert len(world.link.all(ASKED[kind])) == 1


@pytest.mark.parametrize("kind", KINDS)
def test_name_the_robot_has_already_is_not_offered(world: World, kind: str) -> None:
    """This holds also if a client waited for the robot with an offer of that name."""
    person = world.person()
    person.says("set_level", level="error")
    offer(person, kind)
    world.robot_comes()
    appear(world, kind)
    world.robot_joins()
    assert not world.link.all(ASKED[kind])
    assert person.reported() == [f"advertise_{kind} /mine: the robot offers the {kind} /mine itself"]


REQUESTS = ("call_service", "send_action_goal")
ANSWERS = ("service_response", "action_result")


def ask(person: Person, kind: str, id: int = 1) -> None:
    """A client sends a call or goal."""
    if kind == "service":
        person.says("call_service", service="/mine", id=id, args={"a": 1, "b": 2})
    else:
        person.says("send_action_goal", action="/mine", id=id, args={"order": 3})


@pytest.mark.parametrize("kind", KINDS)
def test_an_answer_to_a_former_offer_is_not_taken_for_the_new_one(world: World, kind: str) -> None:
    """The robot answers in order, so requests for one name wait for the earlier answer."""
    person, other = world.at_work(), world.person()
    other.says("set_level", level="error")
    offer(person, kind)
    person.says(f"unadvertise_{kind}", **{kind: "/mine"})
    offer(other, kind)
    assert len(world.link.all(ASKED[kind])) == 1
    world.channel.message(link.Failed(request=f"advertise_{kind}", reference="/mine", reason="no such type"))
    assert not other.reported()
    assert len(world.link.all(ASKED[kind])) == 2


@pytest.mark.parametrize("kind", KINDS)
def test_offers_of_one_client_and_of_one_user_are_bounded(
    world: World, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Per client, per user over all connections, and per robot for all names."""
    monkeypatch.setattr(module, "MAX_OFFERS", 2)
    monkeypatch.setattr(module, "USER_OFFERS", 3)
    person = world.at_work()
    again, stranger = world.person(), world.person(user=8)
    for each in (again, stranger):
        each.says("set_level", level="error")
    for number in range(3):
        offer(person, kind, f"/a{number}")
    assert person.reported() == [f"at most 2 {kind}s can be offered on one connection"]
    for number in range(2):
        offer(again, kind, f"/b{number}")
    assert again.reported() == [f"you offer 3 {kind}s on this robot, the most one user may"]
    monkeypatch.setattr(link_state, "NAMES", 4)
    for number in range(2):
        offer(stranger, kind, f"/c{number}")
    assert stranger.reported() == ["more than 4 names are in use on this robot"]


@pytest.mark.parametrize("kind", KINDS)
def test_no_client_floods_the_robot_with_offers(
    world: World, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The number of open requests is limited; each answer allows the next."""
    monkeypatch.setattr(robot_requests, "OPEN_REQUESTS", 4)
    person = world.at_work()
    for number in range(20):
        offer(person, kind, f"/a{number}")
    assert len(world.link.all(ASKED[kind])) == 4
    confirm(world, kind, "/a0")
    assert len(world.link.all(ASKED[kind])) == 5


def test_changing_offers_in_a_hurry_is_refused(world: World) -> None:
    """As for topics."""
    person = world.at_work()
    for _ in range(1001):
        offer(person, "service")
        person.says("unadvertise_service", service="/mine")
    assert any("too many changes at once" in each for each in person.reported())
    assert len(world.link.all(link.AdvertiseService)) == 1


def test_a_channel_that_is_closed_offers_nothing(world: World) -> None:
    """Its clients may still be connected."""
    person = world.at_work()
    offer(person, "service")
    world.channel.close()
    assert world.channels.find(world.robot) is None
    assert not person.context.channel.services._offered
