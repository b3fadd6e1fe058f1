"""The users of a realm, its groups, its users' tokens and programs: as an administrator sees and changes them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.queries import AlreadyExists, GroupRecord, OAuthClientRecord, QuotaExceeded, UserRecord
from relay_db.queries.oauth import PROGRAMS_OF_ONE
from relay_protocol.errors import NotFound, Refused
from relay_protocol.scopes import Scope
from relay_server.realms.realm_change import (
    ANYTHING,
    Precondition,
    RealmChangeTransaction,
    group_in,
    new_name,
    no_types,
    user_in,
)
from relay_server.resources.page import PageQuery


def about(s: Session, realm: str) -> dict[str, Any]:
    """The realm itself."""
    size, found = queries.realm_size(s, realm), queries.find_realm(s, realm)
    return {
        "realm": realm,
        "users": size.users,
        "groups": size.groups,
        "robots": size.robots,
        "programs": size.programs,
        "robot_groups": size.robot_groups,
        "events_days": None if found is None else found.events_days,
    }


def keep_events(
    change: RealmChangeTransaction, days: float | None, seen: Precondition = ANYTHING
) -> dict[str, Any]:
    """Say how long the realm's memory keeps events; ``None``: as long as the relay's.

    :raises Refused: by a token for less than all
    :raises NotAsBefore: the realm is not as was seen
    :raises Invalid: not more than 0 days, or too many
    """
    change.needs_whole()
    seen.check(about(change.session, change.realm))
    change.keep_events(change.realm, days)
    return about(change.session, change.realm)


# --- users ------------------------------------------------------------------------------------------------


def users(s: Session, realm: str, listing: PageQuery) -> dict[str, Any]:
    """A page of them."""
    found, behind = listing.page({each.name: each for each in queries.list_users(s, realm)}, no_types)
    groups = queries.groups_of(s, [each.id for _, each in found])
    return {"users": [_user(each, groups.get(each.id, ())) for _, each in found], "next": behind}


def user(s: Session, realm: str, name: str) -> dict[str, Any]:
    """:raises NotFound: no such user"""
    return _told(s, user_in(s, realm, name))


def add_user(
    change: RealmChangeTransaction, name: str, password_hash: str | None, admin: bool
) -> dict[str, Any]:
    """:raises Invalid: the name can't be
    :raises Taken: there is one of this name
    :raises NoRoom: there are too many
    :raises Refused: the token in use is for less than all
    """
    change.needs_whole()
    name = new_name(name, "user")
    if queries.find_user(change.session, name, change.realm) is not None:
        raise AlreadyExists(f"there is a user '{name}' already")
    change.see_room("users")
    return _user(change.add_user(name, change.realm, password_hash, admin=admin), ())


def change_user(
    change: RealmChangeTransaction,
    name: str,
    password_hash: str | None,
    disabled: bool | None,
    admin: bool | None,
    seen: Precondition = ANYTHING,
) -> dict[str, Any]:
    """What is ``None`` stays as it is.

    :raises NotFound: no such user
    :raises NotAsBefore: he is not as was seen
    :raises Needed: he shuts himself out, or would be no administrator any more
    :raises Refused: anything but to disable, by a token for less than all
    """
    if not disabled or password_hash is not None or admin is not None:
        change.needs_whole()
    found = change.user(name)
    seen.check(_told(change.session, found))
    if disabled:
        change.see_another(found, "disable")
    if admin is False:
        change.see_another(found, "take administration from")
    if password_hash is not None and found.home is not None:
        # In words of its own: those of the query would name an account of another realm.
        raise Refused(
            "this is a guest of your realm, whose password is that of an account elsewhere: it is changed there"
        )
    if password_hash is not None:
        # The session in which somebody changes his own password goes on.
        found = change.set_password(found, password_hash, keep_token=change.principal.token_id)
    # A guest may be shut out by another realm as well: that it is already is no reason not to keep this.
    if disabled is not None and (found.home is not None or disabled != found.disabled):
        found = change.set_disabled(found, disabled)
    if admin is not None and admin != found.admin:
        change.set_admin(found, admin)
    return _told(change.session, change.user(name))


def remove_user(change: RealmChangeTransaction, name: str) -> None:
    """:raises NotFound: no such user
    :raises Needed: it is himself
    :raises Refused: the token in use is for less than all
    """
    change.needs_whole()
    found = change.user(name)
    change.see_another(found, "remove")
    change.remove_user(found)


def _told(s: Session, record: UserRecord) -> dict[str, Any]:
    return _user(record, queries.groups_of(s, [record.id]).get(record.id, ()))


def _user(record: UserRecord, groups: Sequence[str]) -> dict[str, Any]:
    return {
        "user": record.name,
        "admin": record.admin,
        "disabled": record.disabled,
        "password": record.password_hash is not None,
        "guest": record.home is not None,
        "groups": list(groups),
    }


# --- groups -----------------------------------------------------------------------------------------------


def groups(s: Session, realm: str, listing: PageQuery) -> dict[str, Any]:
    """A page of them, with who is in them."""
    found, behind = listing.page(queries.group_names(s, realm), no_types)
    members = queries.members_of(s, [number for _, number in found])
    return {"groups": [_group(name, members.get(number, ())) for name, number in found], "next": behind}


def group(s: Session, realm: str, name: str) -> dict[str, Any]:
    """:raises NotFound: no such group"""
    found: GroupRecord = group_in(s, realm, name)
    return _group(found.name, sorted(found.members))


def add_group(change: RealmChangeTransaction, name: str) -> dict[str, Any]:
    """:raises Invalid: the name can't be
    :raises Taken: there is one of this name
    :raises NoRoom: there are too many
    :raises Refused: the token in use is for less than all
    """
    change.needs_whole()
    name = new_name(name, "group")
    if queries.find_group(change.session, name, change.realm) is not None:
        raise AlreadyExists(f"there is a group '{name}' already")
    change.see_room("groups")
    return _group(change.add_group(name, change.realm).name, ())


def remove_group(change: RealmChangeTransaction, name: str) -> None:
    """:raises NotFound: no such group
    :raises Refused: the token in use is for less than all
    """
    change.needs_whole()
    change.remove_group(change.group(name))


def join(change: RealmChangeTransaction, name: str, user: str) -> None:
    """:raises NotFound: no such group or user
    :raises NoRoom: too many are in groups
    :raises Refused: the token in use is for less than all
    """
    change.needs_whole()
    found, member = change.group(name), change.user(user)
    if member.name not in found.members:
        change.see_room("memberships")
        change.join(found, member)


def leave(change: RealmChangeTransaction, name: str, user: str) -> None:
    """:raises NotFound: no such group or user, or the user is not in it
    :raises Refused: the token in use is for less than all
    """
    change.needs_whole()
    if not change.leave(change.group(name), change.user(user)):
        raise NotFound("the user is not in this group")


def _group(name: str, members: Sequence[str]) -> dict[str, Any]:
    return {"group": name, "members": list(members)}


# --- tokens -----------------------------------------------------------------------------------------------


def tokens(s: Session, realm: str, name: str, listing: PageQuery) -> dict[str, Any]:
    """A page of a user's tokens and browser sessions, without the tokens themselves.

    :raises NotFound: no such user
    """
    found, behind = listing.page(queries.named_tokens(s, user_in(s, realm, name).id), no_types)
    told = [
        {
            "id": id,
            "kind": each.kind,
            "label": each.label,
            "created": each.created,
            "expires": each.expires,
            "scope": each.scope,
        }
        for id, each in found
    ]
    return {"tokens": told, "next": behind}


def revoke_token(change: RealmChangeTransaction, id: str) -> None:
    """:raises NotFound: no user of the realm has such a token"""
    number = queries.find_token(change.session, id, change.realm)
    if number is None or not change.revoke_token(number):
        raise NotFound("nobody in your realm has such a token")


# --- programs ---------------------------------------------------------------------------------------------


def programs(s: Session, realm: str, name: str, listing: PageQuery) -> dict[str, Any]:
    """A page of a user's programs, without their secrets.

    :raises NotFound: no such user
    """
    known = queries.list_programs(s, user_in(s, realm, name).id)
    found, behind = listing.page({each.key: each for each in known}, no_types)
    return {"programs": [_program(each) for _, each in found], "next": behind}


def add_program(change: RealmChangeTransaction, name: str, label: str, scope: str | None) -> dict[str, Any]:
    """:raises NotFound: no such user
    :raises Invalid: the user is disabled, or label or scope can't be
    :raises NoRoom: there are too many
    :raises Refused: the token in use is for less than all, or the user is a guest from another realm
    """
    change.needs_whole()
    found, checked = change.user(name), None if scope is None else str(Scope(scope))
    if found.home is not None:
        # By a program one gets tokens of all realms that its user has an account in.
        raise Refused("this account is a guest's: programs that act as him are a matter of his own realm")
    change.see_room("programs")
    known = queries.list_programs(change.session, found.id)
    if len(known) >= PROGRAMS_OF_ONE:
        raise QuotaExceeded(f"a user has {PROGRAMS_OF_ONE} programs at most; remove some first")
    added, secret = change.add_program(found, checked, label)
    return {**_program(added), "secret": secret}


def revoke_program(change: RealmChangeTransaction, key: str) -> None:
    """:raises NotFound: no user of the realm has such a program"""
    number = queries.program_in(change.session, key, change.realm)
    if number is None or not change.revoke_program(number):
        raise NotFound("nobody in your realm has such a program")


def _program(record: OAuthClientRecord) -> dict[str, Any]:
    return {"key": record.key, "label": record.label, "created": record.created, "scope": record.scope}
