"""Changes of users, groups, robots and rights, each with its audit entry in the same transaction."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal

from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.queries import GroupRecord, OAuthClientRecord, RobotGroupRecord, RobotRecord, UserRecord
from relay_protocol.errors import Invalid
from relay_protocol.limits import ENROLMENT_SECONDS
from relay_server.auth import passwords

GROUP_MARK = "@"
"""Prefix of a group's name where a user's name is possible too."""

Holder = UserRecord | GroupRecord
"""The owner of a right."""


class NotInGroup(Invalid):
    """The robot to be removed from a group is not in it."""


class AuditedChange:
    """A write transaction that adds audit entries to its changes.

    :param actor: who makes the change: ``cli:root``, ``user:toad@lab1``
    :param origin: the client's address
    :param wall: Unix time in seconds
    """

    def __init__(
        self, session: Session, actor: str, origin: str, wall: Callable[[], float] = time.time
    ) -> None:
        # All changes lock in the same order, as databases with several writers require.
        queries.lock_for_change(session)
        self.session = session
        self._actor = actor
        self._origin = origin
        self._wall = wall

    def audit(self, action: str, target: str, **data: Any) -> None:
        """Add an audit entry in the same transaction."""
        queries.append_audit(
            self.session,
            at=self._wall(),
            actor=self._actor,
            action=action,
            target=target,
            origin=self._origin,
            data=data,
        )

    def keep_events(self, realm: str, days: float | None) -> None:
        """:param days: for which a realm's events are stored; ``None`` for the relay's setting
        :raises SwitchboardError: as :func:`relay_db.queries.realms.set_event_retention`
        """
        queries.set_event_retention(self.session, realm, days)
        self.audit("realm.set", realm, events_days=days)

    # --- users --------------------------------------------------------------------------------------------

    def add_user(self, name: str, realm: str, password_hash: str | None, *, admin: bool) -> UserRecord:
        """:param password_hash: ``None`` for a user that only tokens let in
        :raises SwitchboardError: as :func:`relay_db.queries.users.add_user`
        """
        added = queries.add_user(self.session, name, password_hash, admin=admin, realm=realm)
        self.audit("user.add", added.full, admin=admin)
        return added

    def set_password(
        self, user: UserRecord, password_hash: str, *, keep_token: int | None = None
    ) -> UserRecord:
        """Set a password. The user's browser sessions end, except for one that may be kept."""
        queries.set_password(self.session, user.id, password_hash, keep_token=keep_token)
        self.audit("user.password", user.full)
        return user._replace(password_hash=password_hash)

    def set_disabled(self, user: UserRecord, disabled: bool) -> UserRecord:
        """Disable or enable a user."""
        queries.set_disabled(self.session, user.id, disabled)
        self.audit("user.disable" if disabled else "user.enable", user.full)
        return user._replace(disabled=disabled)

    def set_admin(self, user: UserRecord, admin: bool) -> UserRecord:
        """Make a user an administrator of their realm, or take that away."""
        queries.set_admin(self.session, user.id, admin)
        self.audit("user.admin", user.full, admin=admin)
        return user._replace(admin=admin)

    def add_guest(self, user: UserRecord, realm: str) -> UserRecord:
        """Add an account of the same user in another realm.

        :raises SwitchboardError: as :func:`relay_db.queries.sharing.add_linked_account`
        """
        added = queries.add_linked_account(self.session, user.id, realm)
        self.audit("user.join", added.full, home=added.home)
        return added

    def remove_user(self, user: UserRecord) -> None:
        """Remove a user with their rights and tokens, and their accounts in other realms."""
        queries.remove_user(self.session, user.id)
        self.audit("user.remove", user.full)

    # --- groups -------------------------------------------------------------------------------------------

    def add_group(self, name: str, realm: str) -> GroupRecord:
        """:raises SwitchboardError: as :func:`relay_db.queries.users.add_group`"""
        added = queries.add_group(self.session, name, realm)
        self.audit("group.add", added.full)
        return added

    def remove_group(self, group: GroupRecord) -> None:
        """Remove a group with its rights."""
        queries.remove_group(self.session, group.id)
        self.audit("group.remove", group.full)

    def join(self, group: GroupRecord, member: UserRecord) -> None:
        """Put a user into a group.

        :raises Invalid: they belong to different realms
        """
        queries.add_member(self.session, group.id, member.id)
        self.audit("group.join", group.full, user=member.full)

    def leave(self, group: GroupRecord, member: UserRecord) -> bool:
        """Take a user out of a group; false if they were not in it."""
        if not queries.remove_member(self.session, group.id, member.id):
            return False
        self.audit("group.leave", group.full, user=member.full)
        return True

    # --- robots -------------------------------------------------------------------------------------------

    def add_robot(self, name: str, realm: str, description: str) -> tuple[RobotRecord, str]:
        """Add a robot; also returns its enrolment code.

        :raises SwitchboardError: as :func:`relay_db.queries.robots.add_robot`
        """
        added = queries.add_robot(self.session, name, description, realm)
        code = self._issue(added)
        self.audit("robot.add", added.full, description=description)
        return added, code

    def new_code(self, robot: RobotRecord) -> str:
        """A new enrolment code. An earlier one that was not used is void."""
        code = self._issue(robot)
        self.audit("robot.code", robot.full)
        return code

    def _issue(self, robot: RobotRecord) -> str:
        code = passwords.new_enrolment_code()
        expires = self._wall() + ENROLMENT_SECONDS
        queries.issue_enrolment_code(self.session, robot.id, passwords.code_hash(code), expires)
        return code

    def remove_robot(self, robot: RobotRecord, recordings: int = 0) -> None:
        """Remove a robot with its keys and all rights on it.

        :param recordings: how many recordings the relay deletes with it
        """
        queries.remove_robot(self.session, robot.id)
        self.audit("robot.remove", robot.full, **({"recordings": recordings} if recordings else {}))

    def share_robot(self, robot: RobotRecord, realm: str) -> None:
        """Share a robot with another realm.

        :raises SwitchboardError: as :func:`relay_db.queries.sharing.share_robot`
        """
        queries.share_robot(self.session, robot.id, realm)
        self.audit("robot.share", robot.full, realm=realm)

    def unshare_robot(self, robot: RobotRecord, realm: str) -> None:
        """Take a robot out of that realm, with the rights on it that are held there.

        :raises SwitchboardError: as :func:`relay_db.queries.sharing.unshare_robot`
        """
        queries.unshare_robot(self.session, robot.id, realm)
        self.audit("robot.unshare", robot.full, realm=realm)

    def revoke_key(self, robot: RobotRecord, fingerprint: str) -> None:
        """Revoke a key for good.

        :raises NotFound: the robot has no such key, or it is revoked already
        """
        queries.revoke_key(self.session, robot.id, fingerprint, self._wall())
        self.audit("robot.key.revoke", robot.full, fingerprint=fingerprint)

    def set_robot_description(self, robot: RobotRecord, description: str) -> RobotRecord:
        """:raises Invalid: the description is not valid"""
        queries.set_robot_description(self.session, robot.id, description)
        self.audit("robot.describe", robot.full, description=description)
        return robot._replace(description=description)

    # --- groups of robots ---------------------------------------------------------------------------------

    def fill_robot_group(self, name: str, realm: str, robots: Sequence[RobotRecord] = ()) -> RobotGroupRecord:
        """Put robots into a group, which is created if there is none.

        :raises Invalid: the name is not valid, or a robot does not belong to the realm
        :raises NotFound: no such realm
        """
        s = self.session
        found = queries.find_robot_group(s, name, realm) or queries.add_robot_group(s, name, realm)
        for each in robots:
            queries.add_to_robot_group(s, found.id, each.id)
        self.audit("robot.group.add", found.full, robots=[each.full for each in robots])
        return found._replace(robots=queries.robots_of_groups(s, [found.id])[found.id])

    def empty_robot_group(self, group: RobotGroupRecord, robots: Sequence[RobotRecord]) -> RobotGroupRecord:
        """Take robots out of a group.

        :raises NotInGroup: one of them is not in it; the transaction must be rolled back
        """
        for each in robots:
            if not queries.remove_from_robot_group(self.session, group.id, each.id):
                raise NotInGroup(f"{each.full} is not in group {group.full}")
        self.audit("robot.group.remove", group.full, robots=[each.full for each in robots])
        return group._replace(robots=queries.robots_of_groups(self.session, [group.id])[group.id])

    def remove_robot_group(self, group: RobotGroupRecord) -> None:
        """Remove a group of robots. Its robots stay."""
        queries.remove_robot_group(self.session, group.id)
        self.audit("robot.group.remove", group.full, robots=[])

    # --- rights -------------------------------------------------------------------------------------------

    def grant(
        self, robot: RobotRecord, holder: Holder, level: str, allow: Sequence[str], deny: Sequence[str]
    ) -> None:
        """Grant a right; it replaces the holder's right on the robot.

        :raises Invalid: a pattern is not valid, there are too many, or the holder belongs to another realm
        """
        queries.grant_right(self.session, robot.id, level, **holder_ids(holder), allow=allow, deny=deny)
        detail = {"level": level, "allow": list(allow), "deny": list(deny)}
        self._audit_right("right.grant", robot, holder, **detail)

    def revoke(self, robot: RobotRecord, holder: Holder) -> bool:
        """Revoke a right; false if there was none."""
        if not queries.revoke_right(self.session, robot.id, **holder_ids(holder)):
            return False
        self._audit_right("right.revoke", robot, holder)
        return True

    def _audit_right(self, action: str, robot: RobotRecord, holder: Holder, **data: Any) -> None:
        # Long names are cut in the target, but not in the data.
        whose = holder_text(holder)
        self.audit(action, f"{whose} on {robot.full}", holder=whose, robot=robot.full, **data)

    # --- tokens and OAuth clients ------------------------------------------------------------------------------

    def create_token(
        self, user: UserRecord, seconds: float, scope: str | None, label: str
    ) -> tuple[int, str]:
        """The number of a new token, and the token.

        :param scope: already checked; ``None`` for all that the user may
        :raises Invalid: the label is not valid
        """
        number, secret = self._new_token(user, seconds, kind="access", label=label, scope=scope)
        self.audit("token.create", user.full, id=number, ttl_s=seconds, scope=scope, label=label)
        return number, secret

    def _new_token(
        self,
        user: UserRecord,
        seconds: float,
        *,
        kind: Literal["access", "foxglove"],
        label: str,
        scope: str | None,
        robot_id: int | None = None,
    ) -> tuple[int, str]:
        secret, now = passwords.new_token(), self._wall()
        number = queries.create_token(
            self.session,
            user.id,
            passwords.token_hash(secret),
            kind=kind,
            label=label,
            expires=now + seconds,
            now=now,
            scope=scope,
            robot_id=robot_id,
        )
        return number, secret

    def create_foxglove_url(
        self, user: UserRecord, robot: RobotRecord, level: str, seconds: float, label: str
    ) -> tuple[int, str]:
        """The number of a new token for the Foxglove websockets of a robot, and the token.

        :param level: the most that it allows
        :raises Invalid: the label is not valid
        """
        number, secret = self._new_token(
            user, seconds, kind="foxglove", label=label, scope=level, robot_id=robot.id
        )
        detail = {"id": number, "user": user.full, "level": level, "ttl_s": seconds, "label": label}
        self.audit("foxglove_url.create", robot.full, **detail)
        return number, secret

    def revoke_foxglove_url(self, number: int) -> bool:
        """Revoke such a token; false if there is none of that number."""
        found = [each for each in queries.foxglove_tokens(self.session, 0.0) if each.id == number]
        if not found or not queries.revoke_token(self.session, number):
            return False
        robots = {each.id: each.full for each in queries.list_robots(self.session)}
        user = queries.get_user(self.session, found[0].user_id)
        detail = {"id": number, "user": "" if user is None else user.full}
        self.audit("foxglove_url.revoke", robots.get(found[0].robot_id or 0, ""), **detail)
        return True

    def add_oauth_client(
        self, user: UserRecord, scope: str | None, label: str
    ) -> tuple[OAuthClientRecord, str]:
        """Add an OAuth client that acts as a user; also returns its secret.

        :param scope: already checked; ``None`` for all that the user may
        :raises Invalid: the user is disabled or has too many, or the label is not valid
        """
        if user.disabled:
            raise Invalid("the user is disabled; enable it first")
        key, secret = f"swc_{secrets.token_hex(12)}", passwords.new_token()
        queries.add_oauth_client(
            self.session,
            user.id,
            key,
            passwords.digest_ha1(key, secret),
            scope=scope,
            label=label,
            now=self._wall(),
        )
        added = queries.find_oauth_client(self.session, key)
        assert added is not None
        self.audit("oauth_client.add", user.full, id=added.id, key=key, scope=scope, label=label)
        return added, secret

    def revoke_token(self, number: int) -> bool:
        """Revoke a token; false if there is none of that number."""
        whose = queries.user_of_token(self.session, number)
        return self._revoked("token", number, whose, queries.revoke_token(self.session, number))

    def revoke_oauth_client(self, number: int) -> bool:
        """Revoke an OAuth client and its tokens; false if there is none of that number."""
        whose = queries.user_of_oauth_client(self.session, number)
        return self._revoked("oauth_client", number, whose, queries.remove_oauth_client(self.session, number))

    def _revoked(self, what: str, number: int, whose: str | None, done: bool) -> bool:
        if done:
            self.audit(f"{what}.revoke", str(number), user=whose)
        return done


def holder_text(holder: Holder) -> str:
    """The holder of a right with its full name: ``toad@lab1``, ``@crew@lab1``."""
    return holder.full if isinstance(holder, UserRecord) else f"{GROUP_MARK}{holder.full}"


def holder_ids(holder: Holder) -> dict[str, int]:
    """The holder as queries take it."""
    return {"user_id" if isinstance(holder, UserRecord) else "group_id": holder.id}
