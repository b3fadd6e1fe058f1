"""Users, groups and their members."""

from __future__ import annotations

from sqlalchemy import (
    ColumnElement,
    Row,
    Select,
    case,
    delete,
    exists,
    false,
    func,
    insert,
    or_,
    select,
    update,
)
from sqlalchemy.orm import Session, aliased

from relay_db.models import AccessToken, Group, LinkedAccount, Membership, Realm, TokenFamily, User
from relay_db.names import normal_name, normalise
from relay_db.queries.realms import groups_with_realm, realm_id
from relay_db.queries.records import GroupRecord, UserRecord, record_of
from relay_db.queries.revision import bump
from relay_protocol.errors import Invalid, NotFound, Refused
from relay_protocol.realms import DEFAULT_REALM, full_name

_Home = aliased(User)
"""The account in another realm whose password a linked account has."""

_HomeRealm = aliased(Realm)


def find_user(s: Session, name: str, realm: str = DEFAULT_REALM) -> UserRecord | None:
    """The user of a name, whatever its case; also a disabled one."""
    row = s.execute(
        _users().where(User.name == normalise(name), Realm.name == normalise(realm))
    ).one_or_none()
    return None if row is None else _record(row)


def get_user(s: Session, user_id: int) -> UserRecord | None:
    row = s.execute(_users().where(User.id == user_id)).one_or_none()
    return None if row is None else _record(row)


def list_users(s: Session, realm: str | None = None) -> list[UserRecord]:
    """All users, of one realm or of all, by name."""
    query = _users().order_by(User.name, Realm.name)
    if realm is not None:
        query = query.where(Realm.name == normalise(realm))
    return [_record(row) for row in s.execute(query)]


def add_user(
    s: Session, name: str, password_hash: str | None, admin: bool = False, realm: str = DEFAULT_REALM
) -> UserRecord:
    """:param password_hash: ``None`` for a user that can log in only with tokens
    :raises Invalid: the name is not valid, or is taken
    :raises NotFound: no such realm
    """
    name, realm = normal_name(name, "name of a user"), normalise(realm)
    if find_user(s, name, realm) is not None:
        raise Invalid(f"there is a user '{full_name(name, realm)}' already")
    bump(s)
    user_id = s.scalars(
        insert(User)
        .values(
            realm_id=realm_id(s, realm), name=name, password_hash=password_hash, admin=admin, disabled=False
        )
        .returning(User.id)
    ).one()
    return UserRecord(user_id, name, realm, admin, False, password_hash)


def set_password(
    s: Session, user_id: int, password_hash: str | None, *, keep_token: int | None = None
) -> None:
    """Change a password. Browser sessions and refresh tokens of the old one end, in all realms.

    :param keep_token: number of the session that requests the change and does not end
    :raises NotFound: no such user
    :raises Refused: it is a linked account, which has the password of another one
    """
    user = get_user(s, user_id)
    if user is not None and user.home is not None:
        raise Refused(f"the password of {user.full} is that of {user.home}; change it there")
    bump(s)
    _change_user(s, user_id, password_hash=password_hash)
    accounts = [user_id, *_linked_accounts(s, user_id)]
    s.execute(
        delete(AccessToken).where(
            AccessToken.user_id.in_(accounts),
            AccessToken.kind.in_(("session", "login")),
            AccessToken.id != (-1 if keep_token is None else keep_token),
        )
    )
    s.execute(delete(TokenFamily).where(TokenFamily.user_id.in_(accounts)))


def set_disabled(s: Session, user_id: int, disabled: bool) -> None:
    """Disable or enable a user and all accounts linked to it. Rights and tokens stay.

    :raises NotFound: no such user
    """
    bump(s)
    _change_user(s, user_id, disabled=disabled)


def set_admin(s: Session, user_id: int, admin: bool) -> None:
    """:raises NotFound: no such user"""
    bump(s)
    _change_user(s, user_id, admin=admin)


def remove_user(s: Session, user_id: int) -> None:
    """Remove a user with rights, memberships and tokens, and the accounts linked to it.

    :raises NotFound: no such user
    """
    bump(s)
    linked = _linked_accounts(s, user_id)
    # In the same order as check_password_unchanged, which prevents a deadlock.
    s.execute(select(User.id).where(User.id.in_([user_id, *linked])).order_by(User.id).with_for_update())
    s.execute(delete(User).where(User.id.in_(linked)))
    if s.scalar(delete(User).where(User.id == user_id).returning(User.id)) is None:
        raise NotFound("there is no such user")


def user_is_live(s: Session, user_id: int) -> bool:
    """Whether a user exists and is not disabled."""
    return _exists(s, (User.id == user_id) & live_user())


def home_account(s: Session, user_id: int) -> int:
    """The account whose password a user has: the linked one, or the user's own."""
    return s.scalar(select(LinkedAccount.home_user_id).where(LinkedAccount.user_id == user_id)) or user_id


def _linked_accounts(s: Session, home_user_id: int) -> list[int]:
    """The accounts in other realms that are linked to an account."""
    return list(s.scalars(select(LinkedAccount.user_id).where(LinkedAccount.home_user_id == home_user_id)))


def live_user() -> ColumnElement[bool]:
    """Whether neither a user nor the account that it is linked to is disabled."""
    home_disabled = (
        select(LinkedAccount.user_id)
        .join(_Home, _Home.id == LinkedAccount.home_user_id)
        .where(LinkedAccount.user_id == User.id, _Home.disabled)
    )
    return User.disabled.is_(False) & ~home_disabled.exists()


def check_password_unchanged(s: Session, user_id: int, password_hash: str | None) -> None:
    """Check that a user who has just logged in has not changed, and lock the user until the transaction ends.

    :param password_hash: the hash that was stored when the password was checked
    :raises Refused: another one is stored now, or the user was disabled or removed
    """
    home = home_account(s, user_id)
    query = (
        select(User.id, User.password_hash, User.disabled)
        .where(User.id.in_({user_id, home}))
        .order_by(User.id)
        .with_for_update()
    )
    users = {row.id: row for row in s.execute(query)}
    disabled = not {user_id, home} <= users.keys() or any(row.disabled for row in users.values())
    if disabled or users[home].password_hash != password_hash:
        raise Refused("the account was changed while you logged in; log in again")


def find_group(s: Session, name: str, realm: str = DEFAULT_REALM) -> GroupRecord | None:
    """The group of a name, whatever its case."""
    row = s.execute(
        groups_with_realm(Group).where(Group.name == normalise(name), Realm.name == normalise(realm))
    ).one_or_none()
    return None if row is None else _with_members(s, row)


def list_groups(s: Session, realm: str | None = None) -> list[GroupRecord]:
    """All groups with their members, of one realm or of all, by name."""
    query = groups_with_realm(Group).order_by(Group.name)
    if realm is not None:
        query = query.where(Realm.name == normalise(realm))
    return [_with_members(s, row) for row in s.execute(query).all()]


def add_group(s: Session, name: str, realm: str = DEFAULT_REALM) -> GroupRecord:
    """:raises Invalid: the name is not valid, or is taken
    :raises NotFound: no such realm
    """
    name, realm = normal_name(name, "name of a group"), normalise(realm)
    if find_group(s, name, realm) is not None:
        raise Invalid(f"there is a group '{full_name(name, realm)}' already")
    bump(s)
    group_id = s.scalars(
        insert(Group).values(realm_id=realm_id(s, realm), name=name).returning(Group.id)
    ).one()
    return GroupRecord(group_id, name, realm, ())


def remove_group(s: Session, group_id: int) -> None:
    """Remove a group and its rights. Its members stay users.

    :raises NotFound: no such group
    """
    bump(s)
    if s.scalar(delete(Group).where(Group.id == group_id).returning(Group.id)) is None:
        raise NotFound("there is no such group")


def add_member(s: Session, group_id: int, user_id: int) -> None:
    """Put a user into a group, if it is not in it.

    :raises NotFound: no such group or user
    :raises Invalid: they belong to different realms
    """
    group_realm = s.scalar(select(Group.realm_id).where(Group.id == group_id))
    user_realm = s.scalar(select(User.realm_id).where(User.id == user_id))
    if group_realm is None or user_realm is None:
        raise NotFound("there is no such group or user")
    if group_realm != user_realm:
        raise Invalid("the group and the user belong to different realms")
    if not _exists(s, (Membership.group_id == group_id) & (Membership.user_id == user_id)):
        bump(s)
        s.execute(insert(Membership).values(group_id=group_id, user_id=user_id))


def remove_member(s: Session, group_id: int, user_id: int) -> bool:
    """Take a user out of a group; false if it was not in it."""
    bump(s)
    statement = delete(Membership).where(Membership.group_id == group_id, Membership.user_id == user_id)
    return s.scalar(statement.returning(Membership.user_id)) is not None


def _users() -> Select[int, str, str, bool, bool, str | None, str | None, str | None]:
    """Users, with the accounts that they are linked to."""
    password = case((_Home.id.is_not(None), _Home.password_hash), else_=User.password_hash)
    disabled = or_(User.disabled, func.coalesce(_Home.disabled, false()))
    return (
        select(
            User.id,
            User.name,
            Realm.name.label("realm"),
            User.admin,
            disabled.label("disabled"),
            password.label("password_hash"),
            _Home.name.label("home"),
            _HomeRealm.name.label("home_realm"),
        )
        .join(Realm, Realm.id == User.realm_id)
        .outerjoin(LinkedAccount, LinkedAccount.user_id == User.id)
        .outerjoin(_Home, _Home.id == LinkedAccount.home_user_id)
        .outerjoin(_HomeRealm, _HomeRealm.id == _Home.realm_id)
    )


def _record(row: Row[int, str, str, bool, bool, str | None, str | None, str | None]) -> UserRecord:
    home = None if row.home is None else full_name(row.home, row.home_realm)
    return UserRecord(
        id=row.id,
        name=row.name,
        realm=row.realm,
        admin=row.admin,
        disabled=bool(row.disabled),
        password_hash=row.password_hash,
        home=home,
    )


def _change_user(s: Session, user_id: int, **values: str | bool | None) -> None:
    if s.scalar(update(User).where(User.id == user_id).values(**values).returning(User.id)) is None:
        raise NotFound("there is no such user")


def _with_members(s: Session, group: Row[int, str, str]) -> GroupRecord:
    members = s.scalars(
        select(User.name)
        .join(Membership, Membership.user_id == User.id)
        .where(Membership.group_id == group.id)
        .order_by(User.name)
    )
    return record_of(GroupRecord, group, members=tuple(members))


def _exists(s: Session, condition: ColumnElement[bool]) -> bool:
    return bool(s.scalar(select(exists().where(condition))))
