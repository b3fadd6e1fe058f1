"""``/api/v1/realm``: an administrator's own realm, and nothing of another (SPEC section 1.16)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from urllib.parse import quote

from klein import Klein
from msgspec import UNSET, Struct, UnsetType
from msgspec.structs import astuple
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException

from relay_protocol.errors import NotFound
from relay_server.access import Principal
from relay_server.administration import machines, people
from relay_server.administration.desk import RealmDesk
from relay_server.administration.own import Seen
from relay_server.edges import realm_operations as operations
from relay_server.edges.api import Api, body_of
from relay_server.edges.asked import field, query_of
from relay_server.edges.once import see_no_key
from relay_server.edges.realm_operations import PAGED
from relay_server.edges.realm_shapes import (
    Granted,
    NewGroup,
    NewProgram,
    NewRobot,
    NewRobotGroup,
    NewUser,
    RealmChange,
    RobotChange,
    UserChange,
)
from relay_server.edges.tagged import changed, told_facts
from relay_server.openapi import described
from relay_server.resources import Listing, see_known

_PAGED = tuple(each.name for each in PAGED)


class RealmPages:
    """The addresses below ``/api/v1/realm``, for one request."""

    app = Klein()

    def __init__(self, desk: RealmDesk, api: Api) -> None:
        self._desk = desk
        self._api = api

    # --- who asks, and what becomes of it -----------------------------------------------------------------

    async def _admitted(self, request: Request, *, changes: bool = False) -> Principal:
        """The administrator who asks; nothing is looked at before he is known to be one."""
        principal = await self._api.principal(request)
        self._desk.admit(principal, changes=changes)
        if request.method == b"POST":
            see_no_key(request)
        if b"%2f" in request.path.lower():
            # Addresses lose slashes (edges/site.py): somebody else could be meant by what is left.
            raise NotFound("names with a '/' are not known here; see to them by the command line")
        return principal

    def _told(self, request: Request, query: Callable[..., Any], *args: Any) -> Any:
        async def work() -> Any:
            told = await self._desk.read(await self._admitted(request), query, *args)
            return told_facts(request, told)

        return self._api.answer(request, work())

    def _page(
        self, request: Request, query: Callable[..., Any], *args: Any, filters: tuple[str, ...] = ()
    ) -> Any:
        async def work() -> Any:
            principal, asked = await self._admitted(request), query_of(request)
            see_known(asked, *_PAGED, *filters)
            listing = Listing.of({name: text for name, text in asked.items() if name in _PAGED})
            chosen = [asked.get(name) for name in filters]
            page = await self._desk.read(principal, query, *args, listing, *chosen)
            return told_facts(request, page)

        return self._api.answer(request, work())

    def _done(self, request: Request, work: Callable[..., Any], *args: Any) -> Any:
        async def change() -> Any:
            principal = await self._admitted(request, changes=True)
            return await self._desk.change(principal, _address(request), work, *args)

        return self._api.answer(request, change())

    def _added(
        self,
        request: Request,
        kind: type[Struct],
        work: Callable[..., Any],
        place: str,
        named: str,
        *args: Any,
    ) -> Any:
        """Add something that the body says, and answer with it.

        :param kind: of the body, whose fields follow the others in ``work``
        :param place: the collection it is in, where ``named`` is the field that has its name
        """

        async def add() -> Any:
            principal = await self._admitted(request, changes=True)
            new = (None if each is UNSET else each for each in astuple(body_of(request, kind)))
            told = await self._desk.change(principal, _address(request), work, *args, *new)
            return _made(request, told, place, told[named])

        return self._api.answer(request, add())

    @app.route("/", methods=["GET"])
    @described(operations.ABOUT)
    def about(self, request: Request) -> Any:
        return self._told(request, people.about)

    @app.route("/", methods=["PATCH"])
    @described(operations.CHANGE)
    def change(self, request: Request) -> Any:
        return self._api.answer(request, self._change(request))

    async def _change(self, request: Request) -> Any:
        principal = await self._admitted(request, changes=True)
        days = body_of(request, RealmChange).events_days
        told = await self._desk.change(
            principal, _address(request), people.keep_events, days, seen=_seen(request)
        )
        return changed(request, told)

    # --- users --------------------------------------------------------------------------------------------

    @app.route("/users", methods=["GET"])
    @described(operations.USERS)
    def users(self, request: Request) -> Any:
        return self._page(request, people.users)

    @app.route("/users", methods=["POST"])
    @described(operations.NEW_USER)
    def add_user(self, request: Request) -> Any:
        return self._api.answer(request, self._add_user(request))

    async def _add_user(self, request: Request) -> Any:
        principal = await self._admitted(request, changes=True)
        new = body_of(request, NewUser)
        hashed = await self._hash(principal, new.password)
        told = await self._desk.change(
            principal, _address(request), people.add_user, new.name, hashed, new.admin
        )
        return _made(request, told, "users", told["user"])

    @app.route("/users/<name>", methods=["GET"])
    @described(operations.USER)
    def user(self, request: Request, name: str) -> Any:
        return self._told(request, people.user, name)

    @app.route("/users/<name>", methods=["PATCH"])
    @described(operations.CHANGE_USER)
    def change_user(self, request: Request, name: str) -> Any:
        return self._api.answer(request, self._change_user(request, name))

    async def _change_user(self, request: Request, name: str) -> Any:
        principal = await self._admitted(request, changes=True)
        new = body_of(request, UserChange)
        disabled, admin = (None if each is UNSET else each for each in (new.disabled, new.admin))
        wanted = await self._hash(principal, new.password), disabled, admin
        told = await self._desk.change(
            principal, _address(request), people.change_user, name, *wanted, seen=_seen(request)
        )
        return changed(request, told)

    async def _hash(self, principal: Principal, password: str | UnsetType) -> str | None:
        return None if password is UNSET else await self._desk.new_hash(principal, password)

    @app.route("/users/<name>", methods=["DELETE"])
    @described(operations.REMOVE_USER)
    def remove_user(self, request: Request, name: str) -> Any:
        return self._done(request, people.remove_user, name)

    @app.route("/users/<name>/tokens", methods=["GET"])
    @described(operations.TOKENS)
    def tokens(self, request: Request, name: str) -> Any:
        return self._page(request, people.tokens, name)

    @app.route("/tokens/<id>", methods=["DELETE"])
    @described(operations.REVOKE_TOKEN)
    def revoke_token(self, request: Request, id: str) -> Any:
        return self._done(request, people.revoke_token, id)

    # --- programs -----------------------------------------------------------------------------------------

    @app.route("/users/<name>/programs", methods=["GET"])
    @described(operations.PROGRAMS)
    def programs(self, request: Request, name: str) -> Any:
        return self._page(request, people.programs, name)

    @app.route("/users/<name>/programs", methods=["POST"])
    @described(operations.NEW_PROGRAM)
    def add_program(self, request: Request, name: str) -> Any:
        return self._added(request, NewProgram, people.add_program, "programs", "key", name)

    @app.route("/programs/<key>", methods=["DELETE"])
    @described(operations.REVOKE_PROGRAM)
    def revoke_program(self, request: Request, key: str) -> Any:
        return self._done(request, people.revoke_program, key)

    # --- groups -------------------------------------------------------------------------------------------

    @app.route("/groups", methods=["GET"])
    @described(operations.GROUPS)
    def groups(self, request: Request) -> Any:
        return self._page(request, people.groups)

    @app.route("/groups", methods=["POST"])
    @described(operations.NEW_GROUP)
    def add_group(self, request: Request) -> Any:
        return self._added(request, NewGroup, people.add_group, "groups", "group")

    @app.route("/groups/<name>", methods=["GET"])
    @described(operations.GROUP)
    def group(self, request: Request, name: str) -> Any:
        return self._told(request, people.group, name)

    @app.route("/groups/<name>", methods=["DELETE"])
    @described(operations.REMOVE_GROUP)
    def remove_group(self, request: Request, name: str) -> Any:
        return self._done(request, people.remove_group, name)

    @app.route("/groups/<name>/members/<user>", methods=["PUT"])
    @described(operations.JOIN)
    def join(self, request: Request, name: str, user: str) -> Any:
        return self._done(request, people.join, name, user)

    @app.route("/groups/<name>/members/<user>", methods=["DELETE"])
    @described(operations.LEAVE)
    def leave(self, request: Request, name: str, user: str) -> Any:
        return self._done(request, people.leave, name, user)

    # --- robots -------------------------------------------------------------------------------------------

    @app.route("/robots", methods=["GET"])
    @described(operations.ROBOTS)
    def robots(self, request: Request) -> Any:
        return self._page(request, machines.robots)

    @app.route("/robots", methods=["POST"])
    @described(operations.NEW_ROBOT)
    def add_robot(self, request: Request) -> Any:
        return self._added(request, NewRobot, self._desk.enrolling(machines.add_robot), "robots", "robot")

    @app.route("/robots/<name>", methods=["GET"])
    @described(operations.ROBOT)
    def robot(self, request: Request, name: str) -> Any:
        return self._told(request, machines.robot, name)

    @app.route("/robots/<name>", methods=["PATCH"])
    @described(operations.CHANGE_ROBOT)
    def change_robot(self, request: Request, name: str) -> Any:
        return self._api.answer(request, self._change_robot(request, name))

    async def _change_robot(self, request: Request, name: str) -> Any:
        principal = await self._admitted(request, changes=True)
        new = body_of(request, RobotChange)
        description = None if new.description is UNSET else new.description
        told = await self._desk.change(
            principal, _address(request), machines.change_robot, name, description, seen=_seen(request)
        )
        return changed(request, told)

    @app.route("/robots/<name>", methods=["DELETE"])
    @described(operations.REMOVE_ROBOT)
    def remove_robot(self, request: Request, name: str) -> Any:
        return self._api.answer(request, self._remove_robot(request, name))

    async def _remove_robot(self, request: Request, name: str) -> Any:
        principal = await self._admitted(request, changes=True)
        await self._desk.remove_robot(principal, _address(request), name)

    @app.route("/robots/<name>/code", methods=["POST"])
    @described(operations.NEW_CODE)
    def new_code(self, request: Request, name: str) -> Any:
        return self._api.answer(request, self._new_code(request, name))

    async def _new_code(self, request: Request, name: str) -> Any:
        principal = await self._admitted(request, changes=True)
        work = self._desk.enrolling(machines.new_code)
        told = await self._desk.change(principal, _address(request), work, name)
        request.setResponseCode(201)
        return told

    @app.route("/robots/<name>/keys", methods=["GET"])
    @described(operations.KEYS)
    def keys(self, request: Request, name: str) -> Any:
        return self._page(request, machines.keys, name)

    @app.route("/robots/<name>/keys/<fingerprint>", methods=["DELETE"])
    @described(operations.REVOKE_KEY)
    def revoke_key(self, request: Request, name: str, fingerprint: str) -> Any:
        return self._done(request, machines.revoke_key, name, fingerprint)

    # --- groups of robots ---------------------------------------------------------------------------------

    @app.route("/robot-groups", methods=["GET"])
    @described(operations.ROBOT_GROUPS)
    def robot_groups(self, request: Request) -> Any:
        return self._page(request, machines.groups)

    @app.route("/robot-groups", methods=["POST"])
    @described(operations.NEW_ROBOT_GROUP)
    def add_robot_group(self, request: Request) -> Any:
        return self._added(request, NewRobotGroup, machines.add_group, "robot-groups", "group")

    @app.route("/robot-groups/<name>", methods=["GET"])
    @described(operations.ROBOT_GROUP)
    def robot_group(self, request: Request, name: str) -> Any:
        return self._told(request, machines.group, name)

    @app.route("/robot-groups/<name>", methods=["DELETE"])
    @described(operations.REMOVE_ROBOT_GROUP)
    def remove_robot_group(self, request: Request, name: str) -> Any:
        return self._done(request, machines.remove_group, name)

    @app.route("/robot-groups/<name>/members/<member>", methods=["PUT"])
    @described(operations.JOIN_ROBOT)
    def join_robot(self, request: Request, name: str, member: str) -> Any:
        return self._done(request, machines.join, name, member)

    @app.route("/robot-groups/<name>/members/<member>", methods=["DELETE"])
    @described(operations.LEAVE_ROBOT)
    def leave_robot(self, request: Request, name: str, member: str) -> Any:
        return self._done(request, machines.leave, name, member)

    # --- rights -------------------------------------------------------------------------------------------

    @app.route("/rights", methods=["GET"])
    @described(operations.RIGHTS)
    def rights(self, request: Request) -> Any:
        return self._page(request, machines.rights, filters=("robot", "user"))

    @app.route("/rights/<name>/<holder>", methods=["GET"])
    @described(operations.RIGHT)
    def right(self, request: Request, name: str, holder: str) -> Any:
        return self._told(request, machines.right, name, holder)

    @app.route("/rights/<name>/<holder>", methods=["PUT"])
    @described(operations.GRANT)
    def grant(self, request: Request, name: str, holder: str) -> Any:
        return self._api.answer(request, self._grant(request, name, holder))

    async def _grant(self, request: Request, name: str, holder: str) -> Any:
        principal = await self._admitted(request)
        new = body_of(request, Granted)
        self._desk.count(principal, len(new.allow) + len(new.deny))
        given = str(new.level), new.allow, new.deny
        told, fresh = await self._desk.change(
            principal, _address(request), machines.grant, name, holder, *given, seen=_seen(request)
        )
        if fresh:
            _made(request, told, "rights", told["robot"], told["holder"])
        return changed(request, told)

    @app.route("/rights/<name>/<holder>", methods=["DELETE"])
    @described(operations.REVOKE)
    def revoke(self, request: Request, name: str, holder: str) -> Any:
        return self._done(request, machines.revoke, name, holder)

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        answer: bytes = self._api.unrouted(request, failure)
        return answer


def beside(desk: RealmDesk, api: Api) -> IResource:
    """What serves ``/api/v1/realm``."""
    resource: IResource = RealmPages(desk, api).app.resource()
    return resource


def _made(request: Request, told: Any, *names: str) -> Any:
    """The answer about something new, which is at the address of these names."""
    request.setResponseCode(201)
    request.setHeader("location", "/".join([operations.HERE, *(quote(each, safe="@") for each in names)]))
    return told


def _seen(request: Request) -> Seen:
    """What who changes something says that he has seen of it."""
    return Seen(field(request, "if-match"), field(request, "if-none-match"))


def _address(request: Request) -> str:
    return str(getattr(request.getClientAddress(), "host", "local"))
