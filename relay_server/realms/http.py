"""``/api/v1/realm``: administration of the caller's own realm (SPEC 1.16)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, TypeVar, cast
from urllib.parse import quote

from msgspec import UNSET, Meta, Struct, UnsetType
from msgspec.structs import astuple

from relay_protocol import jsontext
from relay_protocol.errors import NotFound
from relay_protocol.limits import NAME
from relay_server.common.etags import tag_of
from relay_server.http.endpoint import ApiRequest, Created, Endpoint, IdempotencyKey, Tagged, endpoint
from relay_server.http.openapi.operation import header
from relay_server.realms import robots, users
from relay_server.realms.realm_change import Precondition
from relay_server.realms.schemas import (
    GrantBody,
    NewGroup,
    NewOAuthClient,
    NewRobot,
    NewRobotGroup,
    NewUser,
    RealmAbout,
    RealmChange,
    RealmCode,
    RealmGroup,
    RealmGroups,
    RealmKeys,
    RealmNewOAuthClient,
    RealmNewRobot,
    RealmOAuthClients,
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
from relay_server.resources.page import PageQuery

T = TypeVar("T")

BASE_PATH = "/api/v1/realm"

_NONE = header("If-None-Match", "`*`: only if the holder has no right on the robot")
_IN_PATH = {
    "user": "name of a user",
    "holder": "name of a user, or `@` and the name of a group",
    "fingerprint": "fingerprint of a key",
    "member": "name of a robot",
    "key": "key of an OAuth client",
    "id": "`id` of an earlier answer",
}
_NAMED = {
    "users": "name of a user",
    "groups": "name of a group",
    "robots": "name of a robot",
    "robot-groups": "name of a group",
    "rights": "name of a robot",
}


class RightsQuery(PageQuery, frozen=True, forbid_unknown_fields=True):
    """Filters of a list of rights.

    :param robot: only rights on this robot
    :param user: only rights of this user, including those of groups
    """

    robot: Annotated[str, Meta(max_length=NAME)] | UnsetType = UNSET
    user: Annotated[str, Meta(max_length=NAME)] | UnsetType = UNSET


def _endpoint(
    method: str, path: str, summary: str, returns: Any, **options: Any
) -> Callable[[Any], Endpoint]:
    names = {name: words for name, words in _IN_PATH.items() if f"{{{name}}}" in path}
    if "{name}" in path:
        names["name"] = _NAMED[path.partition("/")[0]]
    place = f"{BASE_PATH}/{path}" if path else BASE_PATH
    return endpoint(method, place, tag="realm", summary=summary, returns=returns, names=names, **options)


def _get(path: str, summary: str, returns: str = "a page", **options: Any) -> Callable[[Any], Endpoint]:
    return _endpoint("GET", path, summary, returns, **options)


def _post(path: str, summary: str, returns: str = "added", **options: Any) -> Callable[[Any], Endpoint]:
    options = {"key": IdempotencyKey.REFUSED, "errors": (409,), **options}
    return _endpoint("POST", path, summary, returns, **options)


def _patch(path: str, summary: str, returns: str, **options: Any) -> Callable[[Any], Endpoint]:
    return _endpoint("PATCH", path, summary, returns, if_match=True, **options)


def _delete(path: str, summary: str, **options: Any) -> Callable[[Any], Endpoint]:
    return _endpoint("DELETE", path, summary, "done", **options)


class RealmEndpoints:
    """A realm, for its administrators."""

    def __init__(self, service: RealmService) -> None:
        self._service = service

    # --- shared by all endpoints --------------------------------------------------------------------------

    def admit(self, request: ApiRequest) -> None:
        """Check that the sender is an administrator, and count the change that the request makes.

        :raises Refused: the sender is not an administrator, or changes the realm too often
        :raises NotFound: the address contains an escaped slash
        """
        http = request.http
        # grant() counts a right by its patterns.
        counted = http.method not in (b"GET", b"HEAD") and not (
            http.method == b"PUT" and http.path.startswith(f"{BASE_PATH}/rights/".encode())
        )
        self._service.admit(request.principal, changes=counted)
        if b"%2f" in http.path.lower():
            # http/site.py removes escaped slashes, so the rest could be the name of another user.
            raise NotFound(
                "names with a '/' are not available here; use the command line 'switchboard' for them"
            )

    async def _read(self, request: ApiRequest, kind: type[T], query: Callable[..., Any], *args: Any) -> T:
        """The result of a query.

        :param kind: its type
        """
        return cast(T, await self._service.read(request.principal, query, *args))

    async def _change(
        self, request: ApiRequest, kind: type[T], work: Callable[..., Any], *args: Any, **more: Any
    ) -> T:
        """The result of a change.

        :param kind: its type
        """
        done = await self._service.change(request.principal, request.address, work, *args, **more)
        return cast(T, done)

    async def _done(self, request: ApiRequest, work: Callable[..., Any], *args: Any) -> None:
        await self._service.change(request.principal, request.address, work, *args)

    async def _added(
        self,
        request: ApiRequest,
        kind: type[T],
        body: Struct,
        work: Callable[..., Any],
        place: str,
        named: str,
        *args: Any,
    ) -> Created[T]:
        """Add a resource. The fields of the body follow the other arguments of ``work``.

        :param kind: type of the result
        :param place: the collection of the resource
        :param named: the field of the result with its name
        """
        new = (None if each is UNSET else each for each in astuple(body))
        added: Any = await self._change(request, kind, work, *args, *new)
        return Created(added, location=_location(place, added[named]))

    @_get("", "The caller's own realm", "the realm")
    async def about(self, request: ApiRequest) -> RealmAbout:
        return await self._read(request, RealmAbout, users.realm_info)

    @_patch(
        "",
        "Set for how long events are stored",
        "the realm",
        more="Needs a token without a scope. It takes effect within ten minutes.",
    )
    async def change(self, request: ApiRequest, body: RealmChange) -> Tagged[RealmAbout]:
        seen = _seen(request)
        return Tagged(await self._change(request, RealmAbout, users.keep_events, body.events_days, seen=seen))

    # --- users --------------------------------------------------------------------------------------------

    @_get("users", "Users")
    async def users(self, request: ApiRequest, query: PageQuery) -> RealmUsers:
        return await self._read(request, RealmUsers, users.users, query)

    @_post("users", "Add a user")
    async def add_user(self, request: ApiRequest, body: NewUser) -> Created[RealmUser]:
        hashed = await self._hash(request, body.password)
        added = await self._change(request, RealmUser, users.add_user, body.name, hashed, body.admin)
        return Created(added, location=_location("users", added["user"]))

    @_get("users/{name}", "One user", "the user")
    async def user(self, request: ApiRequest, name: str) -> RealmUser:
        return await self._read(request, RealmUser, users.user, name)

    @_patch(
        "users/{name}",
        "Change a user",
        "the user",
        more="Administrators can neither disable themselves nor give up administration.",
        errors=(409,),
    )
    async def change_user(self, request: ApiRequest, name: str, body: UserChange) -> Tagged[RealmUser]:
        disabled, admin = (None if each is UNSET else each for each in (body.disabled, body.admin))
        wanted = await self._hash(request, body.password), disabled, admin
        seen = _seen(request)
        return Tagged(await self._change(request, RealmUser, users.change_user, name, *wanted, seen=seen))

    async def _hash(self, request: ApiRequest, password: str | UnsetType) -> str | None:
        return None if password is UNSET else await self._service.new_hash(request.principal, password)

    @_delete("users/{name}", "Remove a user with their rights and tokens", errors=(409,))
    async def remove_user(self, request: ApiRequest, name: str) -> None:
        await self._done(request, users.remove_user, name)

    @_get("users/{name}/tokens", "A user's tokens and browser sessions")
    async def tokens(self, request: ApiRequest, name: str, query: PageQuery) -> RealmTokens:
        return await self._read(request, RealmTokens, users.tokens, name, query)

    @_delete("tokens/{id}", "Revoke a token, and close its connections")
    async def revoke_token(self, request: ApiRequest, id: str) -> None:
        await self._done(request, users.revoke_token, id)

    # --- OAuth clients ------------------------------------------------------------------------------------

    @_get("users/{name}/oauth-clients", "OAuth clients that act as a user")
    async def oauth_clients(self, request: ApiRequest, name: str, query: PageQuery) -> RealmOAuthClients:
        return await self._read(request, RealmOAuthClients, users.oauth_clients, name, query)

    @_post(
        "users/{name}/oauth-clients",
        "Add an OAuth client that acts as a user",
        more="It gets tokens by its key and its secret. The secret is shown only in this answer.",
    )
    async def add_oauth_client(
        self, request: ApiRequest, name: str, body: NewOAuthClient
    ) -> Created[RealmNewOAuthClient]:
        return await self._added(
            request, RealmNewOAuthClient, body, users.add_oauth_client, "oauth-clients", "key", name
        )

    @_delete("oauth-clients/{key}", "Revoke an OAuth client and its tokens, and close their connections")
    async def revoke_oauth_client(self, request: ApiRequest, key: str) -> None:
        await self._done(request, users.revoke_oauth_client, key)

    # --- groups -------------------------------------------------------------------------------------------

    @_get("groups", "Groups of users")
    async def groups(self, request: ApiRequest, query: PageQuery) -> RealmGroups:
        return await self._read(request, RealmGroups, users.groups, query)

    @_post("groups", "Add a group")
    async def add_group(self, request: ApiRequest, body: NewGroup) -> Created[RealmGroup]:
        return await self._added(request, RealmGroup, body, users.add_group, "groups", "group")

    @_get("groups/{name}", "One group", "the group")
    async def group(self, request: ApiRequest, name: str) -> RealmGroup:
        return await self._read(request, RealmGroup, users.group, name)

    @_delete("groups/{name}", "Remove a group with its rights")
    async def remove_group(self, request: ApiRequest, name: str) -> None:
        await self._done(request, users.remove_group, name)

    @_endpoint(
        "PUT",
        "groups/{name}/members/{user}",
        "Put a user into a group",
        "the user is in the group",
        errors=(409,),
    )
    async def join(self, request: ApiRequest, name: str, user: str) -> None:
        await self._done(request, users.join, name, user)

    @_delete("groups/{name}/members/{user}", "Take a user out of a group")
    async def leave(self, request: ApiRequest, name: str, user: str) -> None:
        await self._done(request, users.leave, name, user)

    # --- robots -------------------------------------------------------------------------------------------

    @_get("robots", "Robots, enrolled or not")
    async def robots(self, request: ApiRequest, query: PageQuery) -> RealmRobots:
        return await self._read(request, RealmRobots, robots.robots, query)

    @_post("robots", "Add a robot")
    async def add_robot(self, request: ApiRequest, body: NewRobot) -> Created[RealmNewRobot]:
        work = self._service.with_robots_port(robots.add_robot)
        return await self._added(request, RealmNewRobot, body, work, "robots", "robot")

    @_get("robots/{name}", "One robot", "the robot")
    async def robot(self, request: ApiRequest, name: str) -> RealmRobot:
        return await self._read(request, RealmRobot, robots.robot, name)

    @_patch("robots/{name}", "Change a robot's description", "the robot")
    async def change_robot(self, request: ApiRequest, name: str, body: RobotChange) -> Tagged[RealmRobot]:
        description = None if body.description is UNSET else body.description
        seen = _seen(request)
        return Tagged(
            await self._change(request, RealmRobot, robots.change_robot, name, description, seen=seen)
        )

    @_delete(
        "robots/{name}", "Remove a robot with its keys, rights and recordings", more="Its link is closed."
    )
    async def remove_robot(self, request: ApiRequest, name: str) -> None:
        await self._service.remove_robot(request.principal, request.address, name)

    @_post(
        "robots/{name}/code",
        "A new enrolment code of a robot",
        "the code",
        more="An earlier code that was not used becomes void.",
        errors=(),
    )
    async def new_code(self, request: ApiRequest, name: str) -> Created[RealmCode]:
        work = self._service.with_robots_port(robots.new_code)
        return Created(await self._change(request, RealmCode, work, name))

    @_get("robots/{name}/keys", "All keys that a robot ever had")
    async def keys(self, request: ApiRequest, name: str, query: PageQuery) -> RealmKeys:
        return await self._read(request, RealmKeys, robots.keys, name, query)

    @_delete("robots/{name}/keys/{fingerprint}", "Revoke a key, and close the link that uses it")
    async def revoke_key(self, request: ApiRequest, name: str, fingerprint: str) -> None:
        await self._done(request, robots.revoke_key, name, fingerprint)

    # --- groups of robots ---------------------------------------------------------------------------------

    @_get("robot-groups", "Groups of robots")
    async def robot_groups(self, request: ApiRequest, query: PageQuery) -> RealmRobotGroups:
        return await self._read(request, RealmRobotGroups, robots.groups, query)

    @_post("robot-groups", "Add a group of robots")
    async def add_robot_group(self, request: ApiRequest, body: NewRobotGroup) -> Created[RealmRobotGroup]:
        return await self._added(request, RealmRobotGroup, body, robots.add_group, "robot-groups", "group")

    @_get("robot-groups/{name}", "One group of robots", "the group")
    async def robot_group(self, request: ApiRequest, name: str) -> RealmRobotGroup:
        return await self._read(request, RealmRobotGroup, robots.group, name)

    @_delete("robot-groups/{name}", "Remove a group; its robots stay")
    async def remove_robot_group(self, request: ApiRequest, name: str) -> None:
        await self._done(request, robots.remove_group, name)

    @_endpoint(
        "PUT",
        "robot-groups/{name}/members/{member}",
        "Put a robot into a group",
        "the robot is in the group",
        errors=(409,),
    )
    async def join_robot(self, request: ApiRequest, name: str, member: str) -> None:
        await self._done(request, robots.join, name, member)

    @_delete("robot-groups/{name}/members/{member}", "Take a robot out of a group")
    async def leave_robot(self, request: ApiRequest, name: str, member: str) -> None:
        await self._done(request, robots.leave, name, member)

    # --- rights -------------------------------------------------------------------------------------------

    @_get("rights", "Rights as they were granted", errors=(404,))
    async def rights(self, request: ApiRequest, query: RightsQuery) -> RealmRights:
        robot, user = (None if each is UNSET else each for each in (query.robot, query.user))
        return await self._read(request, RealmRights, robots.rights, query, robot, user)

    @_get("rights/{name}/{holder}", "One right", "the right")
    async def right(self, request: ApiRequest, name: str, holder: str) -> RealmRight:
        return await self._read(request, RealmRight, robots.right, name, holder)

    @_endpoint(
        "PUT",
        "rights/{name}/{holder}",
        "Grant a right; it replaces the holder's right on the robot",
        {200: "an earlier right was replaced", 201: "granted"},
        parameters=(_NONE,),
        if_match=True,
        errors=(409,),
    )
    async def grant(
        self, request: ApiRequest, name: str, holder: str, body: GrantBody
    ) -> Tagged[RealmRight] | Created[RealmRight]:
        self._service.count(request.principal, len(body.allow) + len(body.deny))
        given = str(body.level), body.allow, body.deny
        right, fresh = await self._change(
            request, tuple[RealmRight, bool], robots.grant, name, holder, *given, seen=_seen(request)
        )
        if not fresh:
            return Tagged(right)
        return Created(
            right,
            tag_of(jsontext.encode(right)),
            location=_location("rights", right["robot"], right["holder"]),
        )

    @_delete("rights/{name}/{holder}", "Revoke a right", more="Connections that need it are closed.")
    async def revoke(self, request: ApiRequest, name: str, holder: str) -> None:
        await self._done(request, robots.revoke, name, holder)


def _location(*names: str) -> str:
    """The address of a new resource."""
    return "/".join([BASE_PATH, *(quote(each, safe="@") for each in names)])


def _seen(request: ApiRequest) -> Precondition:
    """The preconditions of a change."""
    return Precondition(request.header("if-match"), request.header("if-none-match"))
