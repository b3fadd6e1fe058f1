"""A realm's users and groups, and its users' tokens and OAuth clients, as administrators see and change them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.queries import AlreadyExists, GroupRecord, OAuthClientRecord, QuotaExceeded, UserRecord
from relay_db.queries.oauth import MAX_OAUTH_CLIENTS
from relay_protocol.errors import NotFound, Refused
from relay_protocol.scopes import Scope
from relay_server.realms.realm_change import (
    NO_PRECONDITION,
    Precondition,
    RealmChangeTransaction,
    group_in,
    new_name,
    no_types,
    user_in,
)
from relay_server.resources.page import PageQuery


def realm_info(s: Session, realm: str) -> dict[str, Any]:
    """The realm itself."""
    size, found = queries.realm_size(s, realm), queries.find_realm(s, realm)
    return {
        "realm": realm,
        "users": size.users,
        "groups": size.groups,
        "robots": size.robots,
        "oauth_clients": size.oauth_clients,
        "robot_groups": size.robot_groups,
        "events_days": None if found is None else found.events_days,
    }


def keep_events(
    change: RealmChangeTransaction, days: float | None, seen: Precondition = NO_PRECONDITION
) -> dict[str, Any]:
    """Set for how long the realm's events are stored; ``None`` for the relay's setting.

    :raises Refused: the token has a scope
    :raises PreconditionFailed: the realm has changed
    :raises Invalid: not more than 0 days, or too many
    """
    change.require_full_scope()
    seen.check(realm_info(change.session, change.realm))
    change.keep_events(change.realm, days)
    return realm_info(change.session, change.realm)


# --- users ------------------------------------------------------------------------------------------------


def users(s: Session, realm: str, listing: PageQuery) -> dict[str, Any]:
    """A page of users."""
    found, behind = listing.page({each.name: each for each in queries.list_users(s, realm)}, no_types)
    groups = queries.groups_of(s, [each.id for _, each in found])
    return {"users": [_user(each, groups.get(each.id, ())) for _, each in found], "next": behind}


def user(s: Session, realm: str, name: str) -> dict[str, Any]:
    """:raises NotFound: no such user"""
    return _info(s, user_in(s, realm, name))


def add_user(
    change: RealmChangeTransaction, name: str, password_hash: str | None, admin: bool
) -> dict[str, Any]:
    """:raises Invalid: the name is not valid
    :raises AlreadyExists: the name is taken
    :raises QuotaExceeded: there are too many
    :raises Refused: the token has a scope
    """
    change.require_full_scope()
    name = new_name(name, "user")
    if queries.find_user(change.session, name, change.realm) is not None:
        raise AlreadyExists(f"the user '{name}' exists already")
    change.check_room("users")
    return _user(change.add_user(name, change.realm, password_hash, admin=admin), ())


def change_user(
    change: RealmChangeTransaction,
    name: str,
    password_hash: str | None,
    disabled: bool | None,
    admin: bool | None,
    seen: Precondition = NO_PRECONDITION,
) -> dict[str, Any]:
    """Change a user; ``None`` leaves a field as it is.

    :raises NotFound: no such user
    :raises PreconditionFailed: the user has changed
    :raises LastAdministrator: the caller would disable their own account, or give up administration
    :raises Refused: any change but disabling, with a token that has a scope
    """
    if not disabled or password_hash is not None or admin is not None:
        change.require_full_scope()
    found = change.user(name)
    seen.check(_info(change.session, found))
    if disabled:
        change.check_not_self(found, "disable")
    if admin is False:
        change.check_not_self(found, "take administration from")
    if password_hash is not None and found.home is not None:
        # The query's own error would name an account of another realm.
        raise Refused(
            "this is a guest of your realm, with the password of an account elsewhere: it is changed there"
        )
    if password_hash is not None:
        # The session in which a user changes their own password goes on.
        found = change.set_password(found, password_hash, keep_token=change.principal.token_id)
    # Another realm may have disabled the guest too, so this is stored even if the guest is disabled already.
    if disabled is not None and (found.home is not None or disabled != found.disabled):
        found = change.set_disabled(found, disabled)
    if admin is not None and admin != found.admin:
        change.set_admin(found, admin)
    return _info(change.session, change.user(name))


def remove_user(change: RealmChangeTransaction, name: str) -> None:
    """:raises NotFound: no such user
    :raises LastAdministrator: it is the caller's own account
    :raises Refused: the token has a scope
    """
    change.require_full_scope()
    found = change.user(name)
    change.check_not_self(found, "remove")
    change.remove_user(found)


def _info(s: Session, record: UserRecord) -> dict[str, Any]:
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
    """A page of groups with their members."""
    found, behind = listing.page(queries.group_names(s, realm), no_types)
    members = queries.members_of(s, [number for _, number in found])
    return {"groups": [_group(name, members.get(number, ())) for name, number in found], "next": behind}


def group(s: Session, realm: str, name: str) -> dict[str, Any]:
    """:raises NotFound: no such group"""
    found: GroupRecord = group_in(s, realm, name)
    return _group(found.name, sorted(found.members))


def add_group(change: RealmChangeTransaction, name: str) -> dict[str, Any]:
    """:raises Invalid: the name is not valid
    :raises AlreadyExists: the name is taken
    :raises QuotaExceeded: there are too many
    :raises Refused: the token has a scope
    """
    change.require_full_scope()
    name = new_name(name, "group")
    if queries.find_group(change.session, name, change.realm) is not None:
        raise AlreadyExists(f"the group '{name}' exists already")
    change.check_room("groups")
    return _group(change.add_group(name, change.realm).name, ())


def remove_group(change: RealmChangeTransaction, name: str) -> None:
    """:raises NotFound: no such group
    :raises Refused: the token has a scope
    """
    change.require_full_scope()
    change.remove_group(change.group(name))


def join(change: RealmChangeTransaction, name: str, user: str) -> None:
    """:raises NotFound: no such group or user
    :raises QuotaExceeded: groups have too many members
    :raises Refused: the token has a scope
    """
    change.require_full_scope()
    found, member = change.group(name), change.user(user)
    if member.name not in found.members:
        change.check_room("memberships")
        change.join(found, member)


def leave(change: RealmChangeTransaction, name: str, user: str) -> None:
    """:raises NotFound: no such group or user, or the user is not in it
    :raises Refused: the token has a scope
    """
    change.require_full_scope()
    if not change.leave(change.group(name), change.user(user)):
        raise NotFound("the user is not in this group")


def _group(name: str, members: Sequence[str]) -> dict[str, Any]:
    return {"group": name, "members": list(members)}


# --- tokens -----------------------------------------------------------------------------------------------


def tokens(s: Session, realm: str, name: str, listing: PageQuery) -> dict[str, Any]:
    """A page of a user's tokens and browser sessions, without the tokens themselves.

    :raises NotFound: no such user
    """
    found, behind = listing.page(queries.tokens_by_name(s, user_in(s, realm, name).id), no_types)
    current = [
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
    return {"tokens": current, "next": behind}


def revoke_token(change: RealmChangeTransaction, id: str) -> None:
    """:raises NotFound: no user of the realm has such a token"""
    number = queries.find_token(change.session, id, change.realm)
    if number is None or not change.revoke_token(number):
        raise NotFound("no user of your realm has such a token")


# --- OAuth clients ---------------------------------------------------------------------------------------------


def oauth_clients(s: Session, realm: str, name: str, listing: PageQuery) -> dict[str, Any]:
    """A page of a user's OAuth clients, without their secrets.

    :raises NotFound: no such user
    """
    known = queries.list_oauth_clients(s, user_in(s, realm, name).id)
    found, behind = listing.page({each.key: each for each in known}, no_types)
    return {"oauth_clients": [_oauth_client(each) for _, each in found], "next": behind}


def add_oauth_client(
    change: RealmChangeTransaction, name: str, label: str, scope: str | None
) -> dict[str, Any]:
    """:raises NotFound: no such user
    :raises Invalid: the user is disabled, or label or scope are not valid
    :raises QuotaExceeded: there are too many
    :raises Refused: the token has a scope, or the user is a guest from another realm
    """
    change.require_full_scope()
    found, checked = change.user(name), None if scope is None else str(Scope(scope))
    if found.home is not None:
        # An OAuth client can get tokens for all realms in which its user has an account.
        raise Refused(
            "this is a guest's account: OAuth clients that act as this user can be added only in their own realm"
        )
    change.check_room("oauth_clients")
    known = queries.list_oauth_clients(change.session, found.id)
    if len(known) >= MAX_OAUTH_CLIENTS:
        raise QuotaExceeded(f"a user may have {MAX_OAUTH_CLIENTS} OAuth clients at most; remove some first")
    added, secret = change.add_oauth_client(found, checked, label)
    return {**_oauth_client(added), "secret": secret}


def revoke_oauth_client(change: RealmChangeTransaction, key: str) -> None:
    """:raises NotFound: no user of the realm has such an OAuth client"""
    number = queries.oauth_client_in(change.session, key, change.realm)
    if number is None or not change.revoke_oauth_client(number):
        raise NotFound("no user of your realm has such an OAuth client")


def _oauth_client(record: OAuthClientRecord) -> dict[str, Any]:
    return {"key": record.key, "label": record.label, "created": record.created, "scope": record.scope}
