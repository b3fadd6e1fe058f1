"""Things of a reader: Thing Descriptions of the robots and Roles that a user may see, and Thing Models of Roles."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Iterable
from contextlib import suppress
from typing import NamedTuple
from urllib.parse import quote

from relay_db.queries import RobotRecord
from relay_protocol import jsontext, link
from relay_protocol.errors import NotFound, SwitchboardError
from relay_protocol.realms import full_name
from relay_protocol.rights import Operation, Rules
from relay_protocol.ros_types import TypeRegistry
from relay_server.access import NO_ROBOT, Access, Principal, may_subscribe
from relay_server.channels.channel import Channels
from relay_server.common.clock import Clock
from relay_server.common.concurrency import gather_per_key, with_timeout
from relay_server.in_process_sessions.pool import InProcessSessionPool, RobotCaller
from relay_server.modules.robot_modules import ModuleRegistry
from relay_server.relay_node import interfaces
from relay_server.relay_node.rosapi import known
from relay_server.relay_node.visible_graph import VisibleGraph, graph_by_rules
from relay_server.resources.states import ResourceLocation
from relay_server.robots.registry import OwnEndpoints, RobotRegistry, RobotState
from relay_server.roles.service import RoleService
from relay_server.wot.data_schema import Schema, data_schema
from relay_server.wot.description import (
    MAX_AFFORDANCES,
    OBJECT,
    RobotThing,
    ThingOperation,
    ThingParameters,
    ThingTopic,
    robot_description,
    thing_id,
)
from relay_server.wot.description import typed as with_types
from relay_server.wot.role_thing import RoleRobot, role_description, role_model

MAX_CACHED = 32
"""Most descriptions of robots in memory."""

MAX_SCHEMA_BYTES = 500_000
"""Most bytes of schemas in one description; further messages are objects without a description."""

MAX_PAGE_BYTES = 4_000_000

TYPE_SECONDS = 5.0
"""Seconds in which a robot must send the definitions of its types. Those that come later are missing."""

RELAY_SERVICES = frozenset(
    f"{interfaces.RELAY}/{name}" for name in ("take_control", "release_control", "stop", "resume", "ping")
)
"""The relay's own services that are actions of a robot. Others are about other resources, or about the graph."""

RESUME = f"{interfaces.RELAY}/resume"

GET_PARAMETERS = "/get_parameters"
SET_PARAMETERS = "/set_parameters"

OF_EACH_NODE = ("rcl_interfaces/", "type_description_interfaces/")
"""Types of the services for parameters and types that each node of ROS has."""

ANYWHERE = "https://relay.invalid"
"""Stands for the relay in descriptions that are made once for all addresses of it."""


class _Readable(NamedTuple):
    """A robot and the rights of the reader."""

    record: RobotRecord
    rules: Rules
    state: RobotState
    graph: VisibleGraph
    modules: tuple[str, ...]
    cameras: tuple[str, ...]


class _ThingDocument(NamedTuple):
    """A description, and what it was made of."""

    record: RobotRecord
    graph: VisibleGraph
    description: link.Describe
    types: TypeRegistry
    modules: tuple[str, ...]
    cameras: tuple[str, ...]
    body: bytes


class ThingPage(NamedTuple):
    """Descriptions, JSON.

    :param next: number of the first Thing after these; ``None`` on the last page
    """

    things: list[bytes]
    next: int | None


class ThingService:
    """Things that a user may see.

    :param pool: sessions in which the robots are asked for definitions
    """

    def __init__(
        self,
        clock: Clock,
        access: Access,
        registry: RobotRegistry,
        channels: Channels,
        pool: InProcessSessionPool,
        roles: RoleService,
        modules: ModuleRegistry,
    ) -> None:
        self._clock = clock
        self._access = access
        self._registry = registry
        self._channels = channels
        self._pool = pool
        self._roles = roles
        self._modules = modules
        self._cache: OrderedDict[tuple[object, ...], _ThingDocument] = OrderedDict()

    # --- robots -------------------------------------------------------------------------------------------

    async def robot(self, caller: RobotCaller, base: str, *, typed: bool = False) -> bytes:
        """The Thing Description of a robot.

        :param base: ``scheme://host[:port]`` of the relay, as the reader sees it
        :param typed: see :func:`relay_server.wot.description.typed`
        :raises NotFound: no such robot, or no right on it
        """
        await self._learn_types(caller)
        # Rights and graph may have changed meanwhile.
        return self._document(await self._readable(caller.principal, caller.robot), base, typed)

    async def check(self, principal: Principal, robot: str) -> None:
        """:raises NotFound: no such robot, or no right on it"""
        await self._readable(principal, robot)

    async def page(self, principal: Principal, address: str, base: str, offset: int, limit: int) -> ThingPage:
        """Descriptions of robots in the order of their names, and then of Roles.

        :param address: the reader's
        :param offset: number of the first one
        :param limit: most descriptions
        """
        robots = sorted(record.name for record, _ in await self._access.robots(principal))
        things = [
            *((True, each) for each in robots),
            *((False, each) for each in await self._seen(principal)),
        ]
        found: list[bytes] = []
        size = 0
        for is_robot, name in things[offset : offset + limit]:
            try:
                if is_robot:
                    body = await self.robot(RobotCaller(principal, name, address), base)
                else:
                    body = await self.role(principal, name, base)
            except NotFound:
                # Its rights were revoked meanwhile, or it was removed.
                body = b""
            size += len(body)
            if found and size > MAX_PAGE_BYTES:
                break
            found.append(body)
        after = offset + len(found)
        return ThingPage([each for each in found if each], after if after < len(things) else None)

    async def _seen(self, principal: Principal) -> list[str]:
        """Names of the Roles that a reader sees."""
        return sorted(await self._roles.roles(principal))

    async def address_of(self, principal: Principal, thing: str, base: str) -> str:
        """The address of the description with this id.

        :raises NotFound: there is none that the principal has a right on
        """
        for record, _ in await self._access.robots(principal):
            if thing_id(base, "robots", record.full) == thing:
                return f"{ResourceLocation('', record.name).address}/td"
        for name in await self._seen(principal):
            if thing_id(base, "roles", full_name(name, principal.realm)) == thing:
                return f"/api/v1/roles/{quote(name, safe='')}/td"
        raise NotFound("there is no Thing of this id, or none that you may see")

    async def _readable(self, principal: Principal, name: str) -> _Readable:
        """:raises NotFound: no such robot, or no right on it"""
        robots = await self._access.robots(principal)
        found = next((each for each in robots if each[0].name == name), None)
        if found is None:
            raise NotFound(NO_ROBOT)
        return self._view(*found)

    def _view(self, record: RobotRecord, rules: Rules) -> _Readable:
        found = self._registry.find(record.id)
        state = found or RobotState(record.id, record.name, record.realm)
        channel = self._channels.find(state)
        ends = OwnEndpoints() if channel is None else channel.own_endpoints()
        return _Readable(
            record,
            rules,
            state,
            graph_by_rules(state, ends, rules),
            modules=()
            if found is None
            else tuple(sorted(each.name for each in self._modules.of(found).modules)),
            cameras=tuple(sorted(each.name for each in state.cameras)),
        )

    async def _learn_types(self, caller: RobotCaller) -> None:
        """Ask the robot for the definitions that its description needs. Those that it does not send are left out.

        :raises NotFound: no such robot, or no right on it
        """
        robot = await self._readable(caller.principal, caller.robot)
        if robot.state.control_link is None:
            return
        missing = {each for each in _types(robot) if _registry_of(robot.state, each) is None}
        if not missing:
            return
        late = "the robot did not send its types in time"
        with suppress(SwitchboardError):
            await with_timeout(self._clock, TYPE_SECONDS, self._ask(caller, sorted(missing)), late)

    async def _ask(self, caller: RobotCaller, types: Iterable[str]) -> None:
        async with self._pool.at(caller) as pooled:
            client = pooled.client

            async def ask(type_name: str) -> None:
                with suppress(SwitchboardError):
                    await known(client, type_name)

            await gather_per_key(deque(types), ask)

    def _document(self, robot: _Readable, base: str, typed: bool) -> bytes:
        key = (robot.record.id, robot.rules.key, typed)
        cached = self._cache.get(key)
        if cached is None or not _is_of(cached, robot):
            cached = self._cache[key] = _make(robot, typed)
        self._cache.move_to_end(key)
        while len(self._cache) > MAX_CACHED:
            self._cache.popitem(last=False)
        there = thing_id(base, "robots", robot.record.full), base
        # The id first: the base is a part of no other text.
        anywhere = thing_id(ANYWHERE, "robots", robot.record.full), ANYWHERE
        body = cached.body
        for old, new in zip(anywhere, there, strict=True):
            body = body.replace(old.encode(), new.encode())
        return body

    # --- Roles --------------------------------------------------------------------------------------------

    async def role(self, principal: Principal, name: str, base: str, *, typed: bool = False) -> bytes:
        """The Thing Description of a Role.

        :param typed: as for :meth:`robot`
        :raises NotFound: there is none that the user may see
        """
        robots = await self._robots(principal)
        elements = await self._roles.elements(principal, name)
        full = full_name(name, principal.realm)
        description = role_description(name, full, elements, robots, base)
        return jsontext.encode(with_types(description) if typed else description)

    async def model(self, principal: Principal, name: str) -> bytes:
        """The Thing Model of a Role.

        :raises NotFound: there is none that the user may see
        """
        robots = await self._robots(principal)
        return jsontext.encode(role_model(name, await self._roles.elements(principal, name), robots))

    async def _robots(self, principal: Principal) -> dict[str, RoleRobot]:
        found = [self._view(*each) for each in await self._access.robots(principal)]
        return {each.record.name: RoleRobot(each.rules, each.graph) for each in found}


def _is_of(cached: _ThingDocument, robot: _Readable) -> bool:
    return (
        cached.record == robot.record
        and cached.graph is robot.graph
        and cached.description is robot.state.description
        and cached.types is robot.state.types
        and (cached.modules, cached.cameras) == (robot.modules, robot.cameras)
    )


def _make(robot: _Readable, typed: bool) -> _ThingDocument:
    state, schemas = robot.state, _SchemaBudget(robot.state)
    description = robot_description(_thing(robot), ANYWHERE, schemas.of)
    body = jsontext.encode(with_types(description) if typed else description)
    return _ThingDocument(
        robot.record, robot.graph, state.description, state.types, robot.modules, robot.cameras, body
    )


class _SchemaBudget:
    """Schemas of messages for one description, each made once.

    :param state: the robot, which has the types
    """

    def __init__(self, state: RobotState) -> None:
        self._state = state
        self._left = MAX_SCHEMA_BYTES
        self._known: dict[str, tuple[Schema, int]] = {}

    def of(self, type_name: str) -> Schema:
        """The schema of a message, or of a part of a service or action."""
        found = self._known.get(type_name)
        if found is None:
            schema = self._make(type_name)
            found = self._known[type_name] = schema, len(jsontext.encode(schema))
        schema, size = found
        if size > self._left:
            return OBJECT
        self._left -= size
        return schema

    def _make(self, type_name: str) -> Schema:
        types = _registry_of(self._state, type_name)
        return OBJECT if types is None else data_schema(types.definitions(type_name), type_name)


def _registry_of(state: RobotState, type_name: str) -> TypeRegistry | None:
    """Where the definition of a type is known, if anywhere."""
    for types in (interfaces.TYPES, state.types):
        if type_name and types.knows(type_name):
            return types
    return None


def _types(robot: _Readable) -> set[str]:
    thing = _thing(robot)
    types = {each.type for each in thing.topics}
    return (types | {each.type for each in (*thing.services, *thing.actions)}) - {""}


def _thing(robot: _Readable) -> RobotThing:
    """The part of a robot that the reader may use."""
    record, rules, state, graph, modules, cameras = robot
    decide, motion = rules.decide, state.description.motion
    topics = [
        ThingTopic(
            name,
            _first(topic.types),
            may_subscribe(decide, state, name, topic.types).allowed,
            decide(Operation.PUBLISH, name).allowed,
            state.is_motion(name, _first(topic.types)),
        )
        for name, topic in graph.topics.items()
    ]
    services = [
        ThingOperation(name, _first(service.types), name == RESUME or motion.moves_by_service(name))
        for name, service in graph.services.items()
        if _is_own(name, service)
    ]
    actions = [
        ThingOperation(name, _first(action.types), motion.moves_by_action(name))
        for name, action in graph.actions.items()
        if name not in interfaces.OWN_ACTIONS
    ]
    left_out = sum(max(0, len(each) - MAX_AFFORDANCES) for each in (topics, services, actions))
    return RobotThing(
        record.name,
        record.full,
        record.description,
        _note(state),
        topics[:MAX_AFFORDANCES],
        services[:MAX_AFFORDANCES],
        actions[:MAX_AFFORDANCES],
        left_out,
        _parameters(graph, rules),
        [each for each in modules if decide(Operation.MANAGE, each).allowed][:MAX_AFFORDANCES],
        [each for each in cameras if decide(Operation.VIEW, each).allowed][:MAX_AFFORDANCES],
    )


def _parameters(graph: VisibleGraph, rules: Rules) -> ThingParameters:
    """By the rights to the services of nodes for parameters."""
    may = {
        ending: any(
            name.endswith(ending) and rules.decide(Operation.CALL, name).allowed for name in graph.services
        )
        for ending in (GET_PARAMETERS, SET_PARAMETERS)
    }
    return ThingParameters(may[GET_PARAMETERS], may[SET_PARAMETERS])


def _note(state: RobotState) -> str:
    if state.control_link is not None:
        return ""
    return "Read its description at its own address." if state.elsewhere else "It is offline."


def _first(types: list[str]) -> str:
    return next(iter(types), "")


def _is_own(name: str, service: link.Service) -> bool:
    """Whether a service is one of the robot's own kind, or one of the relay's for each robot."""
    if name.startswith((f"{interfaces.RELAY}/", f"{interfaces.ROSAPI}/")):
        return name in RELAY_SERVICES
    return not any(each.startswith(OF_EACH_NODE) for each in service.types)
