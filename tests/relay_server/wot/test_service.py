"""Affordances of a robot's Thing Description by the reader's rights, and when it is made again."""

from __future__ import annotations

from typing import Any, cast

import msgspec
import pytest
import pytest_twisted

from relay_db import queries
from relay_protocol import link
from relay_protocol.errors import NotFound
from relay_server.access import Principal
from relay_server.in_process_sessions.pool import InProcessSessionPool, RobotCaller
from relay_server.roles.schemas import RoleElement
from relay_server.wot.service import ThingService
from tests.worlds.relay import GRAPH, STRING, TEXTS, TRIGGER, TWIST
from tests.worlds.session_manager import HERE, SessionsWorld

BASE = "https://relay.example"
MANY = [f"/many/t{number}" for number in range(600)]


class Roles:
    """The reader sees one Role."""

    async def roles(self, principal: Principal) -> dict[str, None]:
        return {"Pad-Drive-Rover": None}

    async def elements(self, principal: Principal, name: str) -> list[RoleElement]:
        return [RoleElement("CHAT", [], ["robots/rover/topics/chatter"], [])]


def service_of(front: SessionsWorld) -> ThingService:
    world = front.world
    pool = InProcessSessionPool(world.clock, front.service)
    return ThingService(
        world.clock,
        front.access,
        world.registry,
        world.channels,
        pool,
        cast(Any, Roles()),
        front.world.modules,
    )


def robot_comes(front: SessionsWorld, graph: link.Graph = GRAPH) -> None:
    """The robot is online, and its types are known."""
    front.world.robot_comes(graph=graph)
    for each in (STRING, TRIGGER, TWIST):
        front.world.robot.types.add(each, TEXTS[each])


async def reader(front: SessionsWorld, level: str, *deny: str) -> Principal:
    await grant(front, level, *deny)
    return await front.by_token(front.ann)


async def grant(front: SessionsWorld, level: str, *deny: str) -> None:
    with front.store.database.begin() as session:
        queries.grant_right(session, front.rover.id, level, user_id=front.ann.id, deny=deny)
    await front.access.refresh()


async def description(service: ThingService, principal: Principal) -> dict[str, Any]:
    return dict(msgspec.json.decode(await service.robot(RobotCaller(principal, "rover", HERE), BASE)))


def operations(affordance: dict[str, Any]) -> set[str]:
    return {each for form in affordance["forms"] for each in form["op"]}


@pytest_twisted.ensureDeferred
async def test_only_what_the_reader_may_use_appears(front: SessionsWorld) -> None:
    robot_comes(front)
    viewer = await reader(front, "viewer", "*:/secret")
    seen = await description(service_of(front), viewer)
    assert seen["title"] == "rover"
    topics = {each for each in seen["properties"] if not each.startswith(("relay/", "freshness"))}
    assert topics == {"chatter", "cmd_vel"}
    assert operations(seen["properties"]["chatter"]) == {
        "readproperty", "observeproperty", "unobserveproperty"
    }  # fmt: skip
    assert "reset" not in seen["actions"] and "relay/stop" in seen["actions"]


@pytest_twisted.ensureDeferred
async def test_an_operator_writes_and_invokes(front: SessionsWorld) -> None:
    robot_comes(front)
    seen = await description(service_of(front), await reader(front, "operator"))
    chatter, moving = seen["properties"]["chatter"], seen["properties"]["cmd_vel"]
    assert "writeproperty" in operations(chatter) and "readOnly" not in chatter
    assert chatter["properties"]["value"]["properties"] == {"data": {"type": "string"}}
    assert moving["forms"][1]["href"] == f"{BASE}/api/v1/robots/rover/topics/cmd_vel{{?freshness}}"
    assert "freshness-token" in seen["properties"] and "uriVariables" not in chatter
    assert seen["actions"]["reset"]["forms"][0]["href"] == f"{BASE}/api/v1/robots/rover/services/reset"


@pytest_twisted.ensureDeferred
async def test_parameters_modules_and_cameras_appear_by_the_readers_rights(front: SessionsWorld) -> None:
    nodes = {f"/{node}/{what}_parameters": [f"rcl_interfaces/srv/{what.capitalize()}Parameters"]
             for node in ("base", "arm") for what in ("get", "set")}  # fmt: skip
    services = {name: link.Service(types=types, providers=["/base"]) for name, types in nodes.items()}
    robot_comes(front, link.Graph(full=True, services=services))
    service, world = service_of(front), front.world
    ann = await reader(front, "owner")
    first = await description(service, ann)
    assert "module-driver" not in first["properties"]
    driver = link.ModuleInfo(name="driver", kind="command", state="running")
    world.modules.of(world.robot).message_received(link.Modules(modules=[driver]))
    world.registry.cameras(world.robot, link.Cameras(cameras=[link.Camera(name="/cam/image")]))
    own = await description(service, ann)
    there = f"{BASE}/api/v1/robots/rover"
    properties, actions = own["properties"], own["actions"]
    assert properties["parameter-list"]["forms"][0]["href"] == f"{there}/params{{?after}}"
    parameter = properties["parameter"]
    assert (parameter["forms"][0]["href"], operations(parameter)) == (
        f"{there}/params/{{+name}}",
        {"readproperty", "writeproperty"},
    )
    assert properties["module-driver"]["forms"][0]["href"] == f"{there}/modules/driver"
    for order in ("start", "stop", "restart"):
        assert actions[f"{order}-module-driver"]["forms"][0]["href"] == f"{there}/modules/driver/{order}"
    (image,) = properties["image-of-cam/image"]["forms"]
    assert (image["href"], image["contentType"]) == (
        f"{BASE}/robots/rover/video/snapshot?topic=%2Fcam%2Fimage",
        "image/jpeg",
    )
    denied = "view:/cam/image", "call:/base/*", "call:/arm/set_parameters", "manage:*driver"
    await grant(front, "owner", *denied)
    less = await description(service, ann)
    assert operations(less["properties"]["parameter"]) == {"readproperty"}
    hidden = {each for each in (*less["properties"], *less["actions"]) if "driver" in each or "image" in each}
    assert hidden == set()
    await grant(front, "viewer")
    assert "parameter" not in (await description(service, ann))["properties"]


@pytest_twisted.ensureDeferred
async def test_a_description_is_made_again_after_a_change(front: SessionsWorld) -> None:
    robot_comes(front)
    service, ann = service_of(front), await reader(front, "operator")
    before = await service.robot(RobotCaller(ann, "rover", HERE), BASE)
    assert await service.robot(RobotCaller(ann, "rover", HERE), BASE) == before
    more = link.Graph(topics={"/new": link.Topic(types=[STRING], publishers=["/talker"])})
    front.world.registry.graph(front.world.robot, more)
    assert "new" in (await description(service, ann))["properties"]
    front.world.robot_goes()
    offline = await description(service, ann)
    assert "It is offline." in offline["description"] and "new" not in offline["properties"]


@pytest_twisted.ensureDeferred
async def test_robots_without_a_right_are_unknown(front: SessionsWorld) -> None:
    robot_comes(front)
    service, ann = service_of(front), await reader(front, "viewer")
    with pytest.raises(NotFound):
        await service.robot(RobotCaller(ann, "hidden", HERE), BASE)
    page = await service.page(ann, HERE, BASE, 0, 10)
    assert [msgspec.json.decode(each)["title"] for each in page.things] == ["rover", "Pad-Drive-Rover"]
    assert page.next is None
    assert (await service.page(ann, HERE, BASE, 5, 10)).things == []
    first = await service.page(ann, HERE, BASE, 0, 1)
    assert (len(first.things), first.next) == (1, 1)
    thing, role = (msgspec.json.decode(each) for each in page.things)
    assert "CHAT" in role["properties"]
    assert await service.address_of(ann, thing["id"], BASE) == "/api/v1/robots/rover/td"
    assert await service.address_of(ann, role["id"], BASE) == "/api/v1/roles/Pad-Drive-Rover/td"
    with pytest.raises(NotFound):
        await service.address_of(ann, thing["id"][:-1], BASE)


@pytest_twisted.ensureDeferred
async def test_descriptions_are_bounded(front: SessionsWorld) -> None:
    topic = link.Topic(types=[STRING], publishers=["/talker"])
    robot_comes(front, link.Graph(full=True, topics=dict.fromkeys(MANY, topic)))
    seen = await description(service_of(front), await reader(front, "viewer"))
    assert len(seen["properties"].keys() - {"freshness-token"}) == 500
    assert "are left out." in seen["description"]
