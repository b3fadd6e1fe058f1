"""The graph of a robot in rosapi."""

from __future__ import annotations

from typing import Any, cast

import pytest

from relay_protocol import link
from relay_protocol.rights import Grant, Level, Rules
from relay_server.control.service import ControlService
from relay_server.modules.service import ModuleService
from relay_server.offload.service import FunctionService
from relay_server.pipes.service import PipeService
from relay_server.relay_node import control, functions, modules, pipes, roles, rosapi
from relay_server.relay_node.interfaces import SERVICES, TYPES
from relay_server.relay_node.visible_graph import CACHED_GRAPHS, _cache
from relay_server.roles.commands import RoleCommands
from relay_server.roles.runs import RoleRuns
from tests.worlds.relay import STRING, TRIGGER, TWIST, Person, World
from tests.worlds.relay_node_calls import OWN_SERVICES, ask

STATUS = "switchboard_msgs/msg/Status"
CONTROL = "switchboard_msgs/msg/Control"
MODULES = "switchboard_msgs/msg/Modules"
PROCESSES = "switchboard_msgs/msg/Processes"
OWN = ["/relay/control", "/relay/modules", "/relay/processes", "/relay/status"]
OWN_TYPES = [CONTROL, MODULES, PROCESSES, STATUS]

ANSWERS: list[tuple[str, Any, Any]] = [
    (
        "topics",
        None,
        {"topics": ["/chatter", "/cmd_vel", *OWN], "types": [STRING, TWIST, *OWN_TYPES]},
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
    ("action_servers", None, {"action_servers": ["/dock", "/relay/run_function"]}),
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
    """Names work with and without a slash; denied names are absent, not refused."""
    world.registry.graph(world.robot, ACTIONS)
    assert ask(operator, f"/rosapi/{service}", args) == answer


def test_the_relays_own_services_are_listed_with_the_robots(operator: Person) -> None:
    """rosbridge users expect this; the relay and rosapi are nodes like others."""
    listed = ask(operator, "/rosapi/services")["services"]
    assert listed == sorted(["/reset", *SERVICES])
    own = ask(operator, "/rosapi/node_details", {"node": "/rosapi"})
    assert own["services"] == sorted(rosapi.SERVICES)
    assert len(SERVICES) == OWN_SERVICES


def test_uncallable_services_are_hidden(viewer: Person) -> None:
    """A viewer may call no service of the robot and sees none; the relay's own are open to all."""
    assert ask(viewer, "/rosapi/services") == {"services": sorted(SERVICES)}
    assert ask(viewer, "/rosapi/topics")["topics"] == ["/chatter", "/cmd_vel", *OWN]


def test_hidden_names_are_not_listed(world: World, operator: Person) -> None:
    """Topics and services of actions, and names that begin with an underscore, even of unusual robots."""
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


def test_topics_of_clients_belong_to_the_relay_node(world: World, operator: Person, viewer: Person) -> None:
    """The robot leaves its own daemon out of its graph; other clients see the relay as the node."""
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


def test_services_of_clients_belong_to_the_relay_node(world: World, operator: Person, viewer: Person) -> None:
    """Other clients see them as far as they may call them."""
    operator.says("advertise_service", service="/add", type=TRIGGER)
    operator.says("advertise_action", action="/walk", type="a_msgs/action/Dock")
    other = world.person(deny=("call:/walk",))
    assert ask(other, "/rosapi/service_type", {"service": "/add"}) == {"type": ""}
    world.channel.message(link.AdvertisedService(service="/add", type=TRIGGER))
    world.channel.message(link.AdvertisedAction(action="/walk", type="a_msgs/action/Dock"))
    assert ask(other, "/rosapi/service_type", {"service": "/add"}) == {"type": TRIGGER}
    assert ask(other, "/rosapi/service_node", {"service": "/add"}) == {"node": "/relay"}
    assert ask(other, "/rosapi/action_servers") == {"action_servers": ["/relay/run_function"]}
    assert ask(operator, "/rosapi/action_servers") == {"action_servers": ["/relay/run_function", "/walk"]}
    assert ask(operator, "/rosapi/action_type", {"action": "walk"}) == {"type": "a_msgs/action/Dock"}
    assert "/add" in ask(operator, "/rosapi/node_details", {"node": "/relay"})["services"]
    assert "/add" not in ask(viewer, "/rosapi/services")["services"]
    operator.session.end()
    assert ask(other, "/rosapi/service_node", {"service": "/add"}) == {"node": ""}


def test_a_change_of_rights_or_of_the_graph_shows_at_once(world: World, operator: Person) -> None:
    """A cache is never used after its source has changed."""
    before = ask(operator, "/rosapi/topics")["topics"]
    world.registry.graph(
        world.robot, link.Graph(topics={"/new": link.Topic(types=[STRING]), "/chatter": None})
    )
    assert ask(operator, "/rosapi/topics")["topics"] == sorted({*before, "/new"} - {"/chatter"})
    operator.context.permit.rules = Rules([Grant(Level.VIEWER, deny=("subscribe:/new",))])
    assert ask(operator, "/rosapi/topics")["topics"] == ["/cmd_vel", *OWN, "/secret"]
    world.robot_goes()
    assert ask(operator, "/rosapi/topics")["topics"] == OWN


def test_caches_are_bounded(world: World, viewer: Person) -> None:
    """One view for each set of rights, and a few per robot."""
    for number in range(CACHED_GRAPHS + 5):
        ask(world.person(Level.OPERATOR, deny=(f"*:/t{number}",)), "/rosapi/topics")
    assert len(_cache[world.robot.graph]) == CACHED_GRAPHS


def test_no_answer_has_what_is_denied(world: World) -> None:
    """For all services of rosapi, with any arguments: denied names never appear."""
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
            (reply,) = person.received("service_response")
            # A refusal repeats the caller's words and the rule, whether the name exists or not.
            reported = str(reply["values"]).replace(target.partition(":")[0], "").replace("'*:/secret*'", "")
            assert "secret" not in reported, (service, target)
    assert not world.link.all(link.CallService)


@pytest.mark.parametrize("args", [None, {}, {"topic": 7}, {"topic": None}, [], [7], "text", 7])
def test_invalid_arguments_are_explained(operator: Person, args: Any) -> None:
    """Never by an internal error."""
    assert ask(operator, "/rosapi/topic_type", args) == "give 'topic', a string"


def test_no_handler_fails_inside_on_any_arguments(world: World) -> None:
    """The answer is a result or an error text."""
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
    replies = operator.received("service_response")
    assert len(replies) == len(rosapi.SERVICES) * len(strange)
    assert all("failed on this call" not in str(reply["values"]) for reply in replies)


def test_an_unknown_service_of_the_relay_is_judged_like_any(viewer: Person, operator: Person) -> None:
    """It does not exist, which is not disclosed to a viewer."""
    assert "needs the level operator" in ask(viewer, "/rosapi/delete_everything")
    assert "does not exist" in ask(operator, "/rosapi/delete_everything")


def test_every_service_has_a_handler_and_a_type_whose_fields_its_answers_have(operator: Person) -> None:
    """Answers of rosapi have exactly the fields of rosapi_msgs."""
    about_control = control.ControlRosServices(cast(ControlService, None)).handlers()
    about_modules = modules.ModuleRosServices(cast(ModuleService, None)).handlers()
    about_pipes = pipes.PipeRosServices(cast(PipeService, None)).handlers()
    about_roles = roles.RoleRosServices(cast(RoleCommands, None), cast(RoleRuns, None)).handlers()
    about_functions = functions.FunctionRosServices(cast(FunctionService, None)).handlers()
    about = {"/relay/ping", *about_functions, *about_control, *about_modules, *about_pipes, *about_roles}
    assert set(SERVICES) - about == set(rosapi.SERVICES)
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
        (reply,) = operator.received("service_response")
        assert reply["result"], reply
        response = f"{SERVICES[name].type}_Response"
        if name == "/rosapi/get_time":
            for former in ("secs", "nsecs"):  # for roslibpy
                del reply["values"]["time"][former]
        TYPES.from_json(response, reply["values"], 0)
        (fields,) = [each["fieldnames"] for each in TYPES.typedefs(response)[:1]]
        assert set(reply["values"]) == set(fields), name


def test_thousands_of_topics_are_listed_without_checking_rights_again(
    world: World, operator: Person, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second call of callers with the same rights checks no right again."""
    topics = {f"/t/{number}": link.Topic(types=[STRING], publishers=["/talker"]) for number in range(2000)}
    world.registry.graph(world.robot, link.Graph(full=True, topics=dict(topics)))
    assert len(ask(operator, "/rosapi/topics")["topics"]) == 2000 + len(OWN)
    judged: list[str] = []
    monkeypatch.setattr(Rules, "decide", lambda rules, operation, name: judged.append(name))
    assert len(ask(operator, "/rosapi/topics")["topics"]) == 2000 + len(OWN)
    assert not judged
