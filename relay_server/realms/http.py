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
from relay_server.http.api import Api, body_of
from relay_server.http.conditional import TAGGED, answers, changed, told_facts
from relay_server.http.idempotent_requests import see_no_key
from relay_server.http.openapi.operation import ApiOperation, Parameter, Response, described, header, query
from relay_server.http.request_params import KNOWN, UNTYPED, field, query_of
from relay_server.realms import robots, users
from relay_server.realms.realm_change import Precondition
from relay_server.realms.schemas import (
    GrantBody,
    NewGroup,
    NewProgram,
    NewRobot,
    NewRobotGroup,
    NewUser,
    RealmAbout,
    RealmChange,
    RealmCode,
    RealmGroup,
    RealmGroups,
    RealmKeys,
    RealmNewProgram,
    RealmNewRobot,
    RealmPrograms,
    RealmRight,
    RealmRights,
    RealmRobot,
    RealmRobotGroup,
    RealmRobotGroups,
    RealmRobots,
    RealmTokens,
    RealmUser,
    RealmUsers,
    RobotChange,
    UserChange,
)
from relay_server.realms.service import RealmService
from relay_server.resources.page import PageQuery, see_known

HERE = "/api/v1/realm"

PAGED = UNTYPED
_MATCH = header("If-Match", "entity tags: only if it is one of these; `*`: only if it is there")
_NONE = header("If-None-Match", "`*`: only if it is not there")
_PLACED = {"Location": "its address"}
_IN_PATH = {
    "user": "name of a user",
    "group": "name of a group",
    "robot": "name of a robot",
    "holder": "name of a user, or `@` and that of a group",
    "fingerprint": "of a key",
    "member": "name of a robot",
    "key": "of a program",
    "id": "what an earlier answer gave as `id`",
}


def _operation(
    method: str, path: str, summary: str, answers: dict[int, Response], *, named: str = "", **more: Any
) -> ApiOperation:
    """:param named: what ``{name}`` in the address is the name of"""
    inside = {"name": named} if named else {}
    inside |= {
        name: name
        for name in ("user", "member", "holder", "fingerprint", "key", "id")
        if f"{{{name}}}" in path
    }
    placed = tuple(Parameter(name, _IN_PATH[what], str, "path", True) for name, what in inside.items())
    parameters = (*placed, *more.pop("parameters", ()))
    place = f"{HERE}/{path}" if path else HERE
    return ApiOperation(
        method=method,
        path=place,
        tag="realm",
        summary=summary,
        parameters=parameters,
        answers=answers,
        **more,
    )


def _page(path: str, summary: str, page: Any, *others: Parameter, **more: Any) -> ApiOperation:
    return _told(path, summary, "a page", page, parameters=(*PAGED, *others), **more)


def _told(path: str, summary: str, words: str, body: Any, **more: Any) -> ApiOperation:
    """What is read, with an entity tag."""
    parameters = (*more.pop("parameters", ()), KNOWN)
    return _operation("GET", path, summary, answers(words, body), parameters=parameters, **more)


def _new(path: str, summary: str, body: Any, made: Any, **more: Any) -> ApiOperation:
    answers = {201: Response("added", made, headers=_PLACED)}
    return _operation("POST", path, summary, answers, body=body, errors=(409,), **more)


def _gone(path: str, summary: str, **more: Any) -> ApiOperation:
    return _operation("DELETE", path, summary, {204: Response("done")}, **more)


def _joined(path: str, what: str) -> ApiOperation:
    answers = {204: Response(f"the {what} is in it")}
    return _operation("PUT", path, f"Put a {what} into a group", answers, named="group", errors=(409,))


ABOUT = _told("", "The caller's own realm", "the realm", RealmAbout)
CHANGE = _operation(
    "PATCH",
    "",
    "Say how long the realm's memory keeps events",
    {200: Response("the realm", RealmAbout, headers=TAGGED)},
    more="Takes a token without a scope. The relay goes by it within ten minutes.",
    body=RealmChange,
    parameters=(_MATCH,),
    errors=(412,),
)

USERS = _page("users", "Users", RealmUsers)
NEW_USER = _new("users", "Add a user", NewUser, RealmUser)
USER = _told("users/{name}", "One user", "the user", RealmUser, named="user")
CHANGE_USER = _operation(
    "PATCH",
    "users/{name}",
    "Change a user",
    {200: Response("the user", RealmUser, headers=TAGGED)},
    named="user",
    more="Nobody disables himself, or ceases to be an administrator by his own hand.",
    parameters=(_MATCH,),
    body=UserChange,
    errors=(409, 412),
)
REMOVE_USER = _gone("users/{name}", "Remove a user with rights and tokens", named="user", errors=(409,))
TOKENS = _page("users/{name}/tokens", "A user's tokens and browser sessions", RealmTokens, named="user")
REVOKE_TOKEN = _gone("tokens/{id}", "Make a token worthless, and cut what it opened")

PROGRAMS = _page("users/{name}/programs", "A user's programs, which act as him", RealmPrograms, named="user")
NEW_PROGRAM = _new(
    "users/{name}/programs",
    "Add a program that acts as a user",
    NewProgram,
    RealmNewProgram,
    named="user",
    more="It gets tokens by its key and its secret, which is told this once.",
)
REVOKE_PROGRAM = _gone("programs/{key}", "Make a program worthless with its tokens, and cut what they opened")

GROUPS = _page("groups", "Groups of users", RealmGroups)
NEW_GROUP = _new("groups", "Add a group", NewGroup, RealmGroup)
GROUP = _told("groups/{name}", "One group", "the group", RealmGroup, named="group")
REMOVE_GROUP = _gone("groups/{name}", "Remove a group with its rights", named="group")
JOIN = _joined("groups/{name}/members/{user}", "user")
LEAVE = _gone("groups/{name}/members/{user}", "Take a user out of a group", named="group")

ROBOTS = _page("robots", "Robots, enrolled or not", RealmRobots)
NEW_ROBOT = _new("robots", "Add a robot", NewRobot, RealmNewRobot)
ROBOT = _told("robots/{name}", "One robot", "the robot", RealmRobot, named="robot")
CHANGE_ROBOT = _operation(
    "PATCH",
    "robots/{name}",
    "Change a robot's description",
    {200: Response("the robot", RealmRobot, headers=TAGGED)},
    named="robot",
    parameters=(_MATCH,),
    body=RobotChange,
    errors=(412,),
)
REMOVE_ROBOT = _gone(
    "robots/{name}",
    "Remove a robot with its keys, rights and recordings",
    named="robot",
    more="Its link is cut.",
)
NEW_CODE = _operation(
    "POST",
    "robots/{name}/code",
    "A new code for a robot to enrol with",
    {201: Response("the code", RealmCode)},
    named="robot",
    more="One that was not used yet is void.",
)
KEYS = _page("robots/{name}/keys", "All keys that a robot ever had", RealmKeys, named="robot")
REVOKE_KEY = _gone(
    "robots/{name}/keys/{fingerprint}", "Retire a key, and cut a link that uses it", named="robot"
)

ROBOT_GROUPS = _page("robot-groups", "Groups of robots", RealmRobotGroups)
NEW_ROBOT_GROUP = _new("robot-groups", "Add a group of robots", NewRobotGroup, RealmRobotGroup)
ROBOT_GROUP = _told("robot-groups/{name}", "One group of robots", "the group", RealmRobotGroup, named="group")
REMOVE_ROBOT_GROUP = _gone("robot-groups/{name}", "Remove a group; its robots stay", named="group")
JOIN_ROBOT = _joined("robot-groups/{name}/members/{member}", "robot")
LEAVE_ROBOT = _gone("robot-groups/{name}/members/{member}", "Take a robot out of a group", named="group")

RIGHTS = _page(
    "rights",
    "Rights as they were given",
    RealmRights,
    query("robot", "on this robot only"),
    query("user", "of this user only, also by groups"),
    errors=(404,),
)
RIGHT = _told("rights/{name}/{holder}", "One right", "the right", RealmRight, named="robot")
GRANT = _operation(
    "PUT",
    "rights/{name}/{holder}",
    "Give a right, in the place of the one the holder has on the robot",
    {
        200: Response("in the place of another", RealmRight, headers=TAGGED),
        201: Response("given", RealmRight, headers={**_PLACED, **TAGGED}),
    },
    named="robot",
    parameters=(_MATCH, _NONE),
    body=GrantBody,
    errors=(409, 412),
)
REVOKE = _gone(
    "rights/{name}/{holder}", "Take a right away", named="robot", more="What is open by it is cut."
)

_PAGED = tuple(each.name for each in PAGED)


class RealmResource:
    """The addresses below ``/api/v1/realm``, for one request."""

    app = Klein()

    def __init__(self, desk: RealmService, api: Api) -> None:
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
            # Addresses lose slashes (http/site.py): somebody else could be meant by what is left.
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
            listing = PageQuery.of({name: text for name, text in asked.items() if name in _PAGED})
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
    @described(ABOUT)
    def about(self, request: Request) -> Any:
        return self._told(request, users.about)

    @app.route("/", methods=["PATCH"])
    @described(CHANGE)
    def change(self, request: Request) -> Any:
        return self._api.answer(request, self._change(request))

    async def _change(self, request: Request) -> Any:
        principal = await self._admitted(request, changes=True)
        days = body_of(request, RealmChange).events_days
        told = await self._desk.change(
            principal, _address(request), users.keep_events, days, seen=_seen(request)
        )
        return changed(request, told)

    # --- users --------------------------------------------------------------------------------------------

    @app.route("/users", methods=["GET"])
    @described(USERS)
    def users(self, request: Request) -> Any:
        return self._page(request, users.users)

    @app.route("/users", methods=["POST"])
    @described(NEW_USER)
    def add_user(self, request: Request) -> Any:
        return self._api.answer(request, self._add_user(request))

    async def _add_user(self, request: Request) -> Any:
        principal = await self._admitted(request, changes=True)
        new = body_of(request, NewUser)
        hashed = await self._hash(principal, new.password)
        told = await self._desk.change(
            principal, _address(request), users.add_user, new.name, hashed, new.admin
        )
        return _made(request, told, "users", told["user"])

    @app.route("/users/<name>", methods=["GET"])
    @described(USER)
    def user(self, request: Request, name: str) -> Any:
        return self._told(request, users.user, name)

    @app.route("/users/<name>", methods=["PATCH"])
    @described(CHANGE_USER)
    def change_user(self, request: Request, name: str) -> Any:
        return self._api.answer(request, self._change_user(request, name))

    async def _change_user(self, request: Request, name: str) -> Any:
        principal = await self._admitted(request, changes=True)
        new = body_of(request, UserChange)
        disabled, admin = (None if each is UNSET else each for each in (new.disabled, new.admin))
        wanted = await self._hash(principal, new.password), disabled, admin
        told = await self._desk.change(
            principal, _address(request), users.change_user, name, *wanted, seen=_seen(request)
        )
        return changed(request, told)

    async def _hash(self, principal: Principal, password: str | UnsetType) -> str | None:
        return None if password is UNSET else await self._desk.new_hash(principal, password)

    @app.route("/users/<name>", methods=["DELETE"])
    @described(REMOVE_USER)
    def remove_user(self, request: Request, name: str) -> Any:
        return self._done(request, users.remove_user, name)

    @app.route("/users/<name>/tokens", methods=["GET"])
    @described(TOKENS)
    def tokens(self, request: Request, name: str) -> Any:
        return self._page(request, users.tokens, name)

    @app.route("/tokens/<id>", methods=["DELETE"])
    @described(REVOKE_TOKEN)
    def revoke_token(self, request: Request, id: str) -> Any:
        return self._done(request, users.revoke_token, id)

    # --- programs -----------------------------------------------------------------------------------------

    @app.route("/users/<name>/programs", methods=["GET"])
    @described(PROGRAMS)
    def programs(self, request: Request, name: str) -> Any:
        return self._page(request, users.programs, name)

    @app.route("/users/<name>/programs", methods=["POST"])
    @described(NEW_PROGRAM)
    def add_program(self, request: Request, name: str) -> Any:
        return self._added(request, NewProgram, users.add_program, "programs", "key", name)

    @app.route("/programs/<key>", methods=["DELETE"])
    @described(REVOKE_PROGRAM)
    def revoke_program(self, request: Request, key: str) -> Any:
        return self._done(request, users.revoke_program, key)

    # --- groups -------------------------------------------------------------------------------------------

    @app.route("/groups", methods=["GET"])
    @described(GROUPS)
    def groups(self, request: Request) -> Any:
        return self._page(request, users.groups)

    @app.route("/groups", methods=["POST"])
    @described(NEW_GROUP)
    def add_group(self, request: Request) -> Any:
        return self._added(request, NewGroup, users.add_group, "groups", "group")

    @app.route("/groups/<name>", methods=["GET"])
    @described(GROUP)
    def group(self, request: Request, name: str) -> Any:
        return self._told(request, users.group, name)

    @app.route("/groups/<name>", methods=["DELETE"])
    @described(REMOVE_GROUP)
    def remove_group(self, request: Request, name: str) -> Any:
        return self._done(request, users.remove_group, name)

    @app.route("/groups/<name>/members/<user>", methods=["PUT"])
    @described(JOIN)
    def join(self, request: Request, name: str, user: str) -> Any:
        return self._done(request, users.join, name, user)

    @app.route("/groups/<name>/members/<user>", methods=["DELETE"])
    @described(LEAVE)
    def leave(self, request: Request, name: str, user: str) -> Any:
        return self._done(request, users.leave, name, user)

    # --- robots -------------------------------------------------------------------------------------------

    @app.route("/robots", methods=["GET"])
    @described(ROBOTS)
    def robots(self, request: Request) -> Any:
        return self._page(request, robots.robots)

    @app.route("/robots", methods=["POST"])
    @described(NEW_ROBOT)
    def add_robot(self, request: Request) -> Any:
        return self._added(request, NewRobot, self._desk.enrolling(robots.add_robot), "robots", "robot")

    @app.route("/robots/<name>", methods=["GET"])
    @described(ROBOT)
    def robot(self, request: Request, name: str) -> Any:
        return self._told(request, robots.robot, name)

    @app.route("/robots/<name>", methods=["PATCH"])
    @described(CHANGE_ROBOT)
    def change_robot(self, request: Request, name: str) -> Any:
        return self._api.answer(request, self._change_robot(request, name))

    async def _change_robot(self, request: Request, name: str) -> Any:
        principal = await self._admitted(request, changes=True)
        new = body_of(request, RobotChange)
        description = None if new.description is UNSET else new.description
        told = await self._desk.change(
            principal, _address(request), robots.change_robot, name, description, seen=_seen(request)
        )
        return changed(request, told)

    @app.route("/robots/<name>", methods=["DELETE"])
    @described(REMOVE_ROBOT)
    def remove_robot(self, request: Request, name: str) -> Any:
        return self._api.answer(request, self._remove_robot(request, name))

    async def _remove_robot(self, request: Request, name: str) -> Any:
        principal = await self._admitted(request, changes=True)
        await self._desk.remove_robot(principal, _address(request), name)

    @app.route("/robots/<name>/code", methods=["POST"])
    @described(NEW_CODE)
    def new_code(self, request: Request, name: str) -> Any:
        return self._api.answer(request, self._new_code(request, name))

    async def _new_code(self, request: Request, name: str) -> Any:
        principal = await self._admitted(request, changes=True)
        work = self._desk.enrolling(robots.new_code)
        told = await self._desk.change(principal, _address(request), work, name)
        request.setResponseCode(201)
        return told

    @app.route("/robots/<name>/keys", methods=["GET"])
    @described(KEYS)
    def keys(self, request: Request, name: str) -> Any:
        return self._page(request, robots.keys, name)

    @app.route("/robots/<name>/keys/<fingerprint>", methods=["DELETE"])
    @described(REVOKE_KEY)
    def revoke_key(self, request: Request, name: str, fingerprint: str) -> Any:
        return self._done(request, robots.revoke_key, name, fingerprint)

    # --- groups of robots ---------------------------------------------------------------------------------

    @app.route("/robot-groups", methods=["GET"])
    @described(ROBOT_GROUPS)
    def robot_groups(self, request: Request) -> Any:
        return self._page(request, robots.groups)

    @app.route("/robot-groups", methods=["POST"])
    @described(NEW_ROBOT_GROUP)
    def add_robot_group(self, request: Request) -> Any:
        return self._added(request, NewRobotGroup, robots.add_group, "robot-groups", "group")

    @app.route("/robot-groups/<name>", methods=["GET"])
    @described(ROBOT_GROUP)
    def robot_group(self, request: Request, name: str) -> Any:
        return self._told(request, robots.group, name)

    @app.route("/robot-groups/<name>", methods=["DELETE"])
    @described(REMOVE_ROBOT_GROUP)
    def remove_robot_group(self, request: Request, name: str) -> Any:
        return self._done(request, robots.remove_group, name)

    @app.route("/robot-groups/<name>/members/<member>", methods=["PUT"])
    @described(JOIN_ROBOT)
    def join_robot(self, request: Request, name: str, member: str) -> Any:
        return self._done(request, robots.join, name, member)

    @app.route("/robot-groups/<name>/members/<member>", methods=["DELETE"])
    @described(LEAVE_ROBOT)
    def leave_robot(self, request: Request, name: str, member: str) -> Any:
        return self._done(request, robots.leave, name, member)

    # --- rights -------------------------------------------------------------------------------------------

    @app.route("/rights", methods=["GET"])
    @described(RIGHTS)
    def rights(self, request: Request) -> Any:
        return self._page(request, robots.rights, filters=("robot", "user"))

    @app.route("/rights/<name>/<holder>", methods=["GET"])
    @described(RIGHT)
    def right(self, request: Request, name: str, holder: str) -> Any:
        return self._told(request, robots.right, name, holder)

    @app.route("/rights/<name>/<holder>", methods=["PUT"])
    @described(GRANT)
    def grant(self, request: Request, name: str, holder: str) -> Any:
        return self._api.answer(request, self._grant(request, name, holder))

    async def _grant(self, request: Request, name: str, holder: str) -> Any:
        principal = await self._admitted(request)
        new = body_of(request, GrantBody)
        self._desk.count(principal, len(new.allow) + len(new.deny))
        given = str(new.level), new.allow, new.deny
        told, fresh = await self._desk.change(
            principal, _address(request), robots.grant, name, holder, *given, seen=_seen(request)
        )
        if fresh:
            _made(request, told, "rights", told["robot"], told["holder"])
        return changed(request, told)

    @app.route("/rights/<name>/<holder>", methods=["DELETE"])
    @described(REVOKE)
    def revoke(self, request: Request, name: str, holder: str) -> Any:
        return self._done(request, robots.revoke, name, holder)

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        answer: bytes = self._api.unrouted(request, failure)
        return answer


def beside(desk: RealmService, api: Api) -> IResource:
    """What serves ``/api/v1/realm``."""
    resource: IResource = RealmResource(desk, api).app.resource()
    return resource


def _made(request: Request, told: Any, *names: str) -> Any:
    """The answer about something new, which is at the address of these names."""
    request.setResponseCode(201)
    request.setHeader("location", "/".join([HERE, *(quote(each, safe="@") for each in names)]))
    return told


def _seen(request: Request) -> Precondition:
    """What who changes something says that he has seen of it."""
    return Precondition(field(request, "if-match"), field(request, "if-none-match"))


def _address(request: Request) -> str:
    return str(getattr(request.getClientAddress(), "host", "local"))
