"""What rosapi tells of a robot's graph."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.rights import Grant, Level, Rules
from relay_server.relay_node import control, rosapi
from relay_server.relay_node.interfaces import SERVICES, TYPES
from relay_server.relay_node.view import KEPT, _kept
from tests.relay_server.local.asking import OWN_SERVICES, ask
from tests.relay_server.memory import STRING, TRIGGER, TWIST, Person, World

STATUS = "switchboard_msgs/msg/Status"
CONTROL = "switchboard_msgs/msg/Control"
OWN = ["/relay/control", "/relay/status"]

ANSWERS: list[tuple[str, Any, Any]] = [
    (
        "topics",
        None,
        {"topics": ["/chatter", "/cmd_vel", *OWN], "types": [STRING, TWIST, CONTROL, STATUS]},
    ),
    ("topics_for_type", {"type": "std_msgs/String"}, {"topics": ["/chatter"]}),
    ("topics_for_type", {"type": STRING}, {"topics": ["/chatter"]}),
    ("topics_for_type", {"type": "no_msgs/Such"}, {"topics": []}),
    ("topic_type", {"topic": "chatter"}, {"type": STRING}),
    ("topic_type", {"topic": "/secret"}, {"type": ""}),
    ("topic_type", {"topic": "/none"}, {"type": ""}),
    ("topic_type", ["/cmd_vel"], {"type": TWIST}),
    ("topic_type", {"topic": "/relay/status"}, {"type": STATUS}),
    ("publishers", {"topic": "/chatter"}, {"publishers": ["/talker"]}),
    ("publishers", {"topic": "/secret"}, {"publishers": []}),
    ("publishers", {"topic": "relay/status"}, {"publishers": ["/relay"]}),
    ("subscribers", {"topic": "/cmd_vel"}, {"subscribers": ["/base"]}),
    ("services_for_type", {"type": TRIGGER}, {"services": ["/reset"]}),
    ("services_for_type", {"type": "rosapi_msgs/Topics"}, {"services": ["/rosapi/topics"]}),
    ("services_for_type", {"type": "no_srvs/Such"}, {"services": []}),
    ("service_type", {"service": "reset"}, {"type": TRIGGER}),
    ("service_type", {"service": "/vault/open"}, {"type": ""}),
    ("service_type", {"service": "/rosapi/get_param"}, {"type": "rosapi_msgs/srv/GetParam"}),
    ("service_type", {"service": "relay/ping"}, {"type": "switchboard_msgs/srv/Ping"}),
    ("service_node", {"service": "/reset"}, {"node": "/base"}),
    ("service_node", {"service": "/vault/open"}, {"node": ""}),
    ("service_node", {"service": "/rosapi/nodes"}, {"node": "/rosapi"}),
    ("service_node", {"service": "/relay/ping"}, {"node": "/relay"}),
    ("service_providers", {"service": "/reset"}, {"providers": ["/base"]}),
    ("service_providers", {"service": "reset"}, {"providers": ["/base"]}),
    ("service_providers", {"service": "vault/open"}, {"providers": []}),
    ("service_providers", {"service": "std_srvs/Trigger"}, {"providers": ["/base"]}),
    ("nodes", None, {"nodes": ["/base", "/logger", "/relay", "/rosapi", "/talker", "/vault"]}),
    (
        "node_details",
        {"node": "/base"},
        {"subscribing": ["/cmd_vel"], "publishing": [], "services": ["/reset"]},
    ),
    ("node_details", {"node": "vault"}, {"subscribing": [], "publishing": [], "services": []}),
    ("node_details", {"node": "/none"}, {"subscribing": [], "publishing": [], "services": []}),
    (
        "node_details",
        {"node": "relay"},
        {
            "subscribing": [],
            "publishing": OWN,
            "services": sorted(name for name in SERVICES if name.startswith("/relay/")),
        },
    ),
    ("action_servers", None, {"action_servers": ["/dock"]}),
    ("action_type", {"action": "dock"}, {"type": "a_msgs/action/Dock"}),
    ("action_type", {"action": "/vault/dig"}, {"type": ""}),
    ("action_type", {"action": "/none"}, {"type": ""}),
]

ACTIONS = link.Graph(
    actions={
        "/dock": link.Service(types=["a_msgs/action/Dock"], providers=["/base"]),
        "/vault/dig": link.Service(types=["a_msgs/action/Dock"], providers=["/vault"]),
    }
)


@pytest.mark.parametrize(("service", "args", "answer"), ANSWERS)
def test_rosapi_answers_from_the_mirror_what_the_caller_may_use(
    world: World, operator: Person, service: str, args: Any, answer: Any
) -> None:
    """Names with and without slash; what is denied is absent, not refused."""
    world.registry.graph(world.robot, ACTIONS)
    assert ask(operator, f"/rosapi/{service}", args) == answer


def test_the_relays_own_services_are_listed_with_the_robots(operator: Person) -> None:
    """As a rosbridge user expects; the relay and rosapi are nodes like others."""
    listed = ask(operator, "/rosapi/services")["services"]
    assert listed == sorted(["/reset", *SERVICES])
    own = ask(operator, "/rosapi/node_details", {"node": "/rosapi"})
    assert own["services"] == sorted(rosapi.SERVICES)
    assert len(SERVICES) == OWN_SERVICES


def test_what_one_may_not_call_is_not_shown(viewer: Person) -> None:
    """A viewer calls nothing of the robot, and sees no service of it; the relay's own are open to everyone."""
    assert ask(viewer, "/rosapi/services") == {"services": sorted(SERVICES)}
    assert ask(viewer, "/rosapi/topics")["topics"] == ["/chatter", "/cmd_vel", *OWN]


def test_hidden_names_are_not_listed(world: World, operator: Person) -> None:
    """The topics and services an action is made of, and whatever begins with an underscore, even from odd robots."""
    hidden = link.Graph(
        topics={
            "/dock/_action/status": link.Topic(types=[STRING], publishers=["/base"]),
            "/_own": link.Topic(types=[STRING], publishers=["/base"]),
        },
        services={"/dock/_action/send_goal": link.Service(types=[TRIGGER], providers=["/base"])},
    )
    world.registry.graph(world.robot, hidden)
    assert "_" not in "".join(ask(operator, "/rosapi/topics")["topics"]).replace("cmd_vel", "")
    assert ask(operator, "/rosapi/topic_type", {"topic": "/_own"}) == {"type": STRING}
    assert ask(operator, "/rosapi/publishers", {"topic": "/_own"}) == {"publishers": ["/base"]}
    assert ask(operator, "/rosapi/services_for_type", {"type": TRIGGER}) == {"services": ["/reset"]}
    assert ask(operator, "/rosapi/node_details", {"node": "/base"})["publishing"] == []


def test_what_clients_publish_and_hear_is_the_relays(world: World, operator: Person, viewer: Person) -> None:
    """The robot leaves its daemon out of the graph it tells; other clients see the relay there."""
    operator.says("advertise", topic="/plan", type=STRING)
    operator.says("subscribe", topic="/chatter")
    for ask_for in world.link.take(link.Advertise):
        world.channel.message(
            link.Advertised(number=ask_for.number, topic="/plan", type=STRING, encoding="cdr")
        )
    for wanted in world.link.take(link.Subscribe):
        world.subscribed(wanted.number)
    assert ask(viewer, "/rosapi/topic_type", {"topic": "/plan"}) == {"type": STRING}
    assert ask(viewer, "/rosapi/publishers", {"topic": "/plan"}) == {"publishers": ["/relay"]}
    assert ask(viewer, "/rosapi/subscribers", {"topic": "/chatter"}) == {"subscribers": ["/logger", "/relay"]}
    details = ask(viewer, "/rosapi/node_details", {"node": "/relay"})
    assert details["publishing"] == ["/plan", *OWN]
    assert details["subscribing"] == ["/chatter"]
    operator.session.end()
    assert ask(viewer, "/rosapi/topics")["topics"] == ["/chatter", "/cmd_vel", *OWN]
    assert ask(viewer, "/rosapi/subscribers", {"topic": "/chatter"}) == {"subscribers": ["/logger"]}


def test_what_clients_offer_is_the_relays(world: World, operator: Person, viewer: Person) -> None:
    """Services and actions of a client are seen by the others, as far as they may call them."""
    operator.says("advertise_service", service="/add", type=TRIGGER)
    operator.says("advertise_action", action="/walk", type="a_msgs/action/Dock")
    other = world.person(deny=("call:/walk",))
    assert ask(other, "/rosapi/service_type", {"service": "/add"}) == {"type": ""}
    world.channel.message(link.AdvertisedService(service="/add", type=TRIGGER))
    world.channel.message(link.AdvertisedAction(action="/walk", type="a_msgs/action/Dock"))
    assert ask(other, "/rosapi/service_type", {"service": "/add"}) == {"type": TRIGGER}
    assert ask(other, "/rosapi/service_node", {"service": "/add"}) == {"node": "/relay"}
    assert ask(other, "/rosapi/action_servers") == {"action_servers": []}
    assert ask(operator, "/rosapi/action_servers") == {"action_servers": ["/walk"]}
    assert ask(operator, "/rosapi/action_type", {"action": "walk"}) == {"type": "a_msgs/action/Dock"}
    assert "/add" in ask(operator, "/rosapi/node_details", {"node": "/relay"})["services"]
    assert "/add" not in ask(viewer, "/rosapi/services")["services"]
    operator.session.end()
    assert ask(other, "/rosapi/service_node", {"service": "/add"}) == {"node": ""}


def test_a_change_of_rights_or_of_the_graph_shows_at_once(world: World, operator: Person) -> None:
    """What is kept for speed never outlives what it was made of."""
    before = ask(operator, "/rosapi/topics")["topics"]
    world.registry.graph(
        world.robot, link.Graph(topics={"/new": link.Topic(types=[STRING]), "/chatter": None})
    )
    assert ask(operator, "/rosapi/topics")["topics"] == sorted({*before, "/new"} - {"/chatter"})
    operator.session.permit.rules = Rules([Grant(Level.VIEWER, deny=("subscribe:/new",))])
    assert ask(operator, "/rosapi/topics")["topics"] == ["/cmd_vel", *OWN, "/secret"]
    world.robot_goes()
    assert ask(operator, "/rosapi/topics")["topics"] == OWN


def test_what_is_kept_for_speed_is_bounded(world: World, viewer: Person) -> None:
    """One view for each set of rights, a few of one robot."""
    for number in range(KEPT + 5):
        ask(world.person(Level.OPERATOR, deny=(f"*:/t{number}",)), "/rosapi/topics")
    assert len(_kept[world.robot.graph]) == KEPT


def test_no_answer_has_what_is_denied(world: World) -> None:
    """Over all of rosapi, with any arguments: the name of nothing that is denied to the caller."""
    graph = link.Graph(
        topics={"/secret/plan": link.Topic(types=[STRING], publishers=["/base"], subscribers=["/talker"])},
        services={
            name: link.Service(types=[type_name], providers=["/base"])
            for name, type_name in (
                ("/secret/open", TRIGGER),
                ("/secret/node/list_parameters", "rcl_interfaces/srv/ListParameters"),
                ("/secret/node/get_parameters", "rcl_interfaces/srv/GetParameters"),
                ("/secret/node/set_parameters", "rcl_interfaces/srv/SetParameters"),
            )
        },
        actions={"/secret/dig": link.Service(types=["a_msgs/action/Dock"], providers=["/base"])},
    )
    world.robot_comes(["json"])
    world.registry.graph(world.robot, graph)
    person = world.person(Level.OPERATOR, deny=("*:/secret*",))
    world.robot_joins()
    targets = [
        "/secret/plan", "/secret/open", "/secret/dig", "/secret/node:x",
        "/base", "/talker", STRING, TRIGGER, "a_msgs/action/Dock",
    ]  # fmt: skip
    for service in rosapi.SERVICES:
        for target in targets:
            fields = ("topic", "service", "node", "action", "type", "name")
            person.says("call_service", service=service, args=dict.fromkeys(fields, target) | {"value": "1"})
            (reply,) = person.hears("service_response")
            # A refusal says the caller's own words and the rule again, whether the name exists or not.
            told = str(reply["values"]).replace(target.partition(":")[0], "").replace("'*:/secret*'", "")
            assert "secret" not in told, (service, target)
    assert not world.link.all(link.CallService)


@pytest.mark.parametrize("args", [None, {}, {"topic": 7}, {"topic": None}, [], [7], "text", 7])
def test_arguments_that_are_none_are_told_in_words(operator: Person, args: Any) -> None:
    """Never an internal error."""
    assert ask(operator, "/rosapi/topic_type", args) == "give 'topic', a string"


def test_no_handler_fails_inside_on_any_arguments(world: World) -> None:
    """Whatever is sent, the answer is an answer or a sentence."""
    world.robot_comes(["json"])
    operator = world.person()
    world.robot_joins()
    strange: tuple[Any, ...] = (
        None, [], {}, ["x"], {"topic": "x", "service": "x", "node": "x", "name": ":", "value": "["}, 7,
        {"name": "/a:b", "value": "null", "default_value": 3}, {"type": "///", "name": "a" * 10_000},
        {"type": "a/b/c/d", "node": "", "topic": "", "service": "\0"},
    )  # fmt: skip
    for service in rosapi.SERVICES:
        for args in strange:
            operator.says("call_service", service=service, args=args)
    replies = operator.hears("service_response")
    assert len(replies) == len(rosapi.SERVICES) * len(strange)
    assert all("failed on this call" not in str(reply["values"]) for reply in replies)


def test_an_unknown_service_of_the_relay_is_judged_like_any(viewer: Person, operator: Person) -> None:
    """It does not exist; a viewer is not even told that."""
    assert "needs the level operator" in ask(viewer, "/rosapi/delete_everything")
    assert "does not exist" in ask(operator, "/rosapi/delete_everything")


def test_every_service_has_a_handler_and_a_type_whose_fields_its_answers_have(operator: Person) -> None:
    """The answers of rosapi have the fields of rosapi_msgs, neither more nor less."""
    assert set(SERVICES) - {"/relay/ping", *control.SERVICES} == set(rosapi.SERVICES)
    for name in rosapi.SERVICES:
        args = {
            "topic": "/chatter", "service": "/reset", "node": "/base", "action": "/dock",
            "type": "switchboard_msgs/Status", "name": "/base:x", "value": "1",
        }  # fmt: skip
        if "service_re" in name:
            args["type"] = "rosapi_msgs/Topics"
        if "action_" in name and "details" in name:
            continue
        operator.says("call_service", service=name, args=args)
        if name in ("/rosapi/topics_and_raw_types", "/rosapi/interfaces"):
            continue
        (reply,) = operator.hears("service_response")
        assert reply["result"], reply
        response = f"{SERVICES[name].type}_Response"
        if name == "/rosapi/get_time":
            for former in ("secs", "nsecs"):  # for roslibpy
                del reply["values"]["time"][former]
        TYPES.from_json(response, reply["values"], 0)
        (fields,) = [each["fieldnames"] for each in TYPES.typedefs(response)[:1]]
        assert set(reply["values"]) == set(fields), name


def test_thousands_of_topics_are_listed_without_judging_them_anew(
    world: World, operator: Person, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second call of callers with the same rights judges nothing."""
    topics = {f"/t/{number}": link.Topic(types=[STRING], publishers=["/talker"]) for number in range(2000)}
    world.registry.graph(world.robot, link.Graph(full=True, topics=dict(topics)))
    assert len(ask(operator, "/rosapi/topics")["topics"]) == 2002
    judged: list[str] = []
    monkeypatch.setattr(Rules, "judge", lambda rules, operation, name: judged.append(name))
    assert len(ask(operator, "/rosapi/topics")["topics"]) == 2002
    assert not judged
