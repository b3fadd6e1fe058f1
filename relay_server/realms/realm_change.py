"""Changes by an administrator, limited to their own realm."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar

from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.names import normal_name
from relay_db.queries import GroupRecord, QuotaExceeded, RobotGroupRecord, RobotRecord, UserRecord
from relay_protocol import jsontext
from relay_protocol.errors import Invalid, NotFound, Refused
from relay_server.access import BadCredentials, Principal
from relay_server.common.etags import PreconditionFailed, check_match, names, tag_of
from relay_server.realms.changes import GROUP_MARK, AuditedChange, Holder
from relay_server.realms.schemas import MAX_COUNTS, MAX_PATTERNS, MAX_PATTERNS_OF_A_ROBOT

_Record = TypeVar("_Record")


class LastAdministrator(Refused):
    """The realm needs this administrator."""


class Precondition(NamedTuple):
    """The preconditions of a request (RFC 9110 sections 13.1.1 and 13.1.2).

    :param match: ``If-Match``: entity tags of which the resource must have one, or ``*`` if it must exist
    :param none: ``If-None-Match``: entity tags of which it must have none, or ``*`` if it must not exist
    """

    match: str | None = None
    none: str | None = None

    def check(self, current: Mapping[str, Any] | None) -> None:
        """Check the preconditions.

        :param current: the resource as it is now; ``None`` if it does not exist
        :raises PreconditionFailed: they do not hold
        """
        etag = "" if current is None else tag_of(jsontext.encode(current))
        if self.match is not None and current is None:
            raise PreconditionFailed("it no longer exists; read it again")
        if self.match is not None:
            check_match(etag, self.match)
        if self.none is not None and current is not None and names(self.none, etag):
            raise PreconditionFailed("it exists by now; read it")


NO_PRECONDITION = Precondition()
"""No precondition."""


def check_administrator(principal: Principal) -> None:
    """:raises Refused: not an administrator, or the token's scope excludes it"""
    if not principal.admin:
        raise Refused(
            "this is for administrators of the realm, with a token without a scope or with 'admin' in it"
        )


def user_in(s: Session, realm: str, name: str) -> UserRecord:
    return _found(queries.find_user(s, name, realm), "user")


def group_in(s: Session, realm: str, name: str) -> GroupRecord:
    return _found(queries.find_group(s, name, realm), "group")


def robot_in(s: Session, realm: str, name: str) -> RobotRecord:
    return _found(queries.find_robot(s, name, realm), "robot")


def holder_in(s: Session, realm: str, name: str) -> Holder:
    """A user or a group that may hold rights.

    :param name: of a user, or with :data:`GROUP_MARK` before it of a group
    :raises NotFound: no such user or group in the realm
    """
    if name.startswith(GROUP_MARK):
        return group_in(s, realm, name.removeprefix(GROUP_MARK))
    return user_in(s, realm, name)


def robot_group_in(s: Session, realm: str, name: str) -> RobotGroupRecord:
    return _found(queries.find_robot_group(s, name, realm), "group of robots")


def home_robot_in(s: Session, realm: str, name: str) -> RobotRecord:
    """A robot that belongs to the realm itself.

    :raises NotFound: no such robot in the realm
    :raises Refused: it is shared with the realm and belongs to another one
    """
    found = robot_in(s, realm, name)
    if found.realm != realm:
        raise Refused(
            "this robot is shared with your realm: only administrators of its own realm may change its description "
            "or keys, or remove it"
        )
    return found


def _found(record: _Record | None, what: str) -> _Record:
    if record is None:
        raise NotFound(f"there is no such {what} in your realm")
    return record


def no_types(_: object) -> tuple[str, ...]:
    """The types of members of an administrator's lists: they have none."""
    return ()


def new_name(text: str, what: str) -> str:
    """The normal form of a new name that can be part of a URL.

    :raises Invalid: the name is not valid
    """
    name = normal_name(text, f"name of a {what}")
    if "/" in name or name in (".", ".."):
        raise Invalid(
            f"the name of a {what} is part of URLs: it must not contain '/', and must not be '{name}'"
        )
    return name


class RealmChangeTransaction(AuditedChange):
    """A change by an administrator of a realm. Other changes wait until it is done.

    :param origin: the client's address
    :raises BadCredentials: the administrator's token has ended
    :raises Refused: the user is no longer an administrator
    """

    def __init__(
        self, session: Session, principal: Principal, origin: str, wall: Callable[[], float]
    ) -> None:
        super().__init__(session, f"user:{principal.full}", origin, wall)
        standing = queries.principals_by_ids(session, [principal.token_id], wall())
        if not standing:
            raise BadCredentials("your session was ended; log in again")
        check_administrator(Principal.of(standing[0]))
        self.principal = principal
        self.realm = principal.realm

    def user(self, name: str) -> UserRecord:
        return user_in(self.session, self.realm, name)

    def group(self, name: str) -> GroupRecord:
        return group_in(self.session, self.realm, name)

    def robot(self, name: str) -> RobotRecord:
        return robot_in(self.session, self.realm, name)

    def home_robot(self, name: str) -> RobotRecord:
        """A robot that belongs to the realm itself, for changes that concern all realms it is shared with.

        :raises NotFound: no such robot
        :raises Refused: it is shared with the realm and belongs to another one
        """
        return home_robot_in(self.session, self.realm, name)

    def robot_group(self, name: str) -> RobotGroupRecord:
        return robot_group_in(self.session, self.realm, name)

    def holder(self, name: str) -> Holder:
        """:param name: of a user, or with :data:`GROUP_MARK` before it of a group
        :raises NotFound: no such user or group
        """
        return holder_in(self.session, self.realm, name)

    def check_not_self(self, user: UserRecord, what: str) -> None:
        """Check that a change concerns another user. Since the caller is an administrator, the realm keeps
        one.

        :param what: the change, for the error
        :raises LastAdministrator: it is the caller's own account
        """
        if user.id == self.principal.user_id:
            raise LastAdministrator(
                f"you cannot {what} yourself, since the realm might have no administrator left: ask another one, or "
                "an operator of 'switchboard' on the relay's machine"
            )

    def require_full_scope(self) -> None:
        """Check that the token has no scope: a change that may give someone more is not for narrowed tokens.

        :raises Refused: it has one
        """
        self.principal.require_full_scope()

    def check_pattern_room(self, robot: RobotRecord, more: int) -> None:
        """:param more: patterns to be added to the rights on a robot
        :raises QuotaExceeded: there would be too many
        """
        if more <= 0:
            return
        all_ = queries.count_patterns(self.session, realm=self.realm)
        of_robot = queries.count_patterns(self.session, realm=self.realm, robot_id=robot.id)
        if all_ + more > MAX_PATTERNS or of_robot + more > MAX_PATTERNS_OF_A_ROBOT:
            raise QuotaExceeded(
                f"the rights in a realm may have {MAX_PATTERNS} patterns at most, and those on one robot "
                f"{MAX_PATTERNS_OF_A_ROBOT}; use wildcards, or remove some first"
            )

    def check_room(self, what: str) -> None:
        """:param what: a key of :data:`MAX_COUNTS`; one more is to be added
        :raises QuotaExceeded: there are too many already
        """
        if getattr(queries.realm_size(self.session, self.realm), what) >= MAX_COUNTS[what]:
            words = what.replace("oauth", "OAuth").replace("_", " ")
            raise QuotaExceeded(f"a realm may have {MAX_COUNTS[what]} {words} at most; remove some first")
