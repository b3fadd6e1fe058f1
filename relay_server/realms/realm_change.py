"""What an administrator finds and changes in his own realm; there is no other for him."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar

from sqlalchemy.orm import Session
from werkzeug.http import parse_etags

from relay_db import queries
from relay_db.names import normal_name
from relay_db.queries import GroupRecord, QuotaExceeded, RobotGroupRecord, RobotRecord, UserRecord
from relay_protocol import jsontext
from relay_protocol.errors import Invalid, NotFound, Refused
from relay_server.access import BadCredentials, Principal
from relay_server.realms.changes import GROUP_MARK, AuditedChange, Holder
from relay_server.realms.limits import MOST, MOST_PATTERNS, MOST_PATTERNS_OF_A_ROBOT
from relay_server.resources.etags import PreconditionFailed, see_match, tag_of

_Record = TypeVar("_Record")


class Needed(Refused):
    """The realm would have to do without the administrator who asks."""


class Precondition(NamedTuple):
    """What an administrator has seen of what he changes (RFC 9110 sections 13.1.1 and 13.1.2).

    :param match: ``If-Match``: entity tags of which it has one, or ``*``: that it is there
    :param none: ``If-None-Match``: those of which it has none, or ``*``: that it is not there
    """

    match: str | None = None
    none: str | None = None

    def check(self, told: Mapping[str, Any] | None) -> None:
        """See that it is still so.

        :param told: as it is told now; ``None``: it is not there
        :raises NotAsBefore: it is not
        """
        etag = "" if told is None else tag_of(jsontext.encode(told))
        if self.match is not None and told is None:
            raise PreconditionFailed("there is none of it any more; read it again")
        if self.match is not None:
            see_match(etag, self.match)
        if (
            self.none is not None
            and told is not None
            and parse_etags(self.none).contains_weak(etag.strip('"'))
        ):
            raise PreconditionFailed("there is one by now; read it")


ANYTHING = Precondition()
"""However it is, it is to be changed."""


def see_administrator(principal: Principal) -> None:
    """:raises Refused: he is none, or his token is for less"""
    if not principal.admin:
        raise Refused(
            "this is for administrators of the realm, by a token without a scope or with 'admin' in it"
        )


def user_in(s: Session, realm: str, name: str) -> UserRecord:
    """:raises NotFound: no such user in the realm"""
    return _found(queries.find_user(s, name, realm), "user")


def group_in(s: Session, realm: str, name: str) -> GroupRecord:
    """:raises NotFound: no such group in the realm"""
    return _found(queries.find_group(s, name, realm), "group")


def robot_in(s: Session, realm: str, name: str) -> RobotRecord:
    """:raises NotFound: no such robot in the realm"""
    return _found(queries.find_robot(s, name, realm), "robot")


def holder_in(s: Session, realm: str, name: str) -> Holder:
    """Who can have a right.

    :param name: of a user, or with :data:`GROUP_MARK` before it of a group
    :raises NotFound: no such user or group in the realm
    """
    if name.startswith(GROUP_MARK):
        return group_in(s, realm, name.removeprefix(GROUP_MARK))
    return user_in(s, realm, name)


def robot_group_in(s: Session, realm: str, name: str) -> RobotGroupRecord:
    """:raises NotFound: no such group of robots in the realm"""
    return _found(queries.find_robot_group(s, name, realm), "group of robots")


def home_robot_in(s: Session, realm: str, name: str) -> RobotRecord:
    """:raises NotFound: no such robot in the realm
    :raises Refused: it is shared with the realm and of another
    """
    found = robot_in(s, realm, name)
    if found.realm != realm:
        raise Refused(
            "this robot is shared with your realm: its description, its keys, and whether it stays on the relay "
            "are a matter of its own realm"
        )
    return found


def _found(record: _Record | None, what: str) -> _Record:
    if record is None:
        raise NotFound(f"there is no such {what} in your realm")
    return record


def no_types(_: object) -> tuple[str, ...]:
    """Of which types the members of an administrator's lists are: they have none."""
    return ()


def new_name(text: str, what: str) -> str:
    """The one form of the name of something new, which can stand in an address.

    :raises Invalid: the name can't be
    """
    name = normal_name(text, f"name of a {what}")
    if "/" in name or name in (".", ".."):
        raise Invalid(f"the name of a {what} stands in addresses: it has no '/' in it, and is not '{name}'")
    return name


class RealmChangeTransaction(AuditedChange):
    """A change by an administrator of a realm, while he is one: until it is done nobody else changes anything.

    :param origin: his address
    :raises BadCredentials: he can't be proved any more
    :raises Refused: he is no administrator any more
    """

    def __init__(
        self, session: Session, principal: Principal, origin: str, wall: Callable[[], float]
    ) -> None:
        super().__init__(session, f"user:{principal.full}", origin, wall)
        standing = queries.principals_by_ids(session, [principal.token_id], wall())
        if not standing:
            raise BadCredentials("your session was ended; log in again")
        see_administrator(Principal.of(standing[0]))
        self.principal = principal
        self.realm = principal.realm

    def user(self, name: str) -> UserRecord:
        """:raises NotFound: no such user"""
        return user_in(self.session, self.realm, name)

    def group(self, name: str) -> GroupRecord:
        """:raises NotFound: no such group"""
        return group_in(self.session, self.realm, name)

    def robot(self, name: str) -> RobotRecord:
        """:raises NotFound: no such robot"""
        return robot_in(self.session, self.realm, name)

    def home_robot(self, name: str) -> RobotRecord:
        """For what is a matter of the robot's own realm, whatever realms it is shared with.

        :raises NotFound: no such robot
        :raises Refused: it is shared with the realm and of another
        """
        return home_robot_in(self.session, self.realm, name)

    def robot_group(self, name: str) -> RobotGroupRecord:
        """:raises NotFound: no such group of robots"""
        return robot_group_in(self.session, self.realm, name)

    def holder(self, name: str) -> Holder:
        """:param name: of a user, or with :data:`GROUP_MARK` before it of a group
        :raises NotFound: no such user or group
        """
        return holder_in(self.session, self.realm, name)

    def see_another(self, user: UserRecord, what: str) -> None:
        """See that somebody else is meant than who asks. As he is an administrator, the realm keeps one by that.

        :param what: would be done to the user
        :raises Needed: it is himself
        """
        if user.id == self.principal.user_id:
            raise Needed(
                f"you can't {what} yourself, or the realm might have no administrator left: have another one do it, or "
                "who runs 'switchboard' on the relay's machine"
            )

    def needs_whole(self) -> None:
        """See that he asks by a token for all that he may: what may give somebody more is not what a scope narrows.

        :raises Refused: by one for less
        """
        self.principal.needs_whole()

    def see_room_for_patterns(self, robot: RobotRecord, more: int) -> None:
        """:param more: patterns that the rights on a robot are to have beside those there are
        :raises NoRoom: there would be too many
        """
        if more <= 0:
            return
        all_ = queries.count_patterns(self.session, realm=self.realm)
        of_robot = queries.count_patterns(self.session, realm=self.realm, robot_id=robot.id)
        if all_ + more > MOST_PATTERNS or of_robot + more > MOST_PATTERNS_OF_A_ROBOT:
            raise QuotaExceeded(
                f"the rights in a realm have {MOST_PATTERNS} patterns at most, those on one robot "
                f"{MOST_PATTERNS_OF_A_ROBOT}; use wildcards, or remove some first"
            )

    def see_room(self, what: str) -> None:
        """:param what: one of :data:`MOST`, of which there is to be one more
        :raises NoRoom: there are as many as there may be
        """
        if getattr(queries.realm_size(self.session, self.realm), what) >= MOST[what]:
            words = what.replace("_", " ")
            raise QuotaExceeded(f"a realm has {MOST[what]} {words} at most; remove some first")
