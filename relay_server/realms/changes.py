"""Changes to who there is and who may do what, each with its entry in the audit log, in one transaction."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Sequence
from typing import Any

from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.queries import GroupRecord, OAuthClientRecord, RobotGroupRecord, RobotRecord, UserRecord
from relay_protocol.errors import Invalid
from relay_protocol.limits import ENROLMENT_SECONDS
from relay_server.auth import passwords

GROUP_MARK = "@"
"""What stands before the name of a group where a user could be meant."""

Holder = UserRecord | GroupRecord
"""Whom a right belongs to."""


class NotInGroup(Invalid):
    """A robot is to be taken out of a group that it is not in."""


class AuditedChange:
    """A write transaction that says in the audit log what it does.

    :param actor: who does it: ``cli:root``, ``user:toad@lab1``
    :param origin: from which address
    :param wall: Unix time in seconds
    """

    def __init__(
        self, session: Session, actor: str, origin: str, wall: Callable[[], float] = time.time
    ) -> None:
        # Whoever changes locks in the same order, as a database with several writers wants it.
        queries.lock_for_change(session)
        self.session = session
        self._actor = actor
        self._origin = origin
        self._wall = wall

    def audit(self, action: str, target: str, **data: Any) -> None:
        """Record what is being done, in the same transaction."""
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
        """:param days: for which a realm's memory keeps events; ``None``: as long as the relay's
        :raises SwitchboardError: as :func:`relay_db.queries.realms.keep_events`
        """
        queries.keep_events(self.session, realm, days)
        self.audit("realm.set", realm, events_days=days)

    # --- users --------------------------------------------------------------------------------------------

    def add_user(self, name: str, realm: str, password_hash: str | None, *, admin: bool) -> UserRecord:
        """:param password_hash: ``None`` for one that only tokens let in
        :raises SwitchboardError: as :func:`relay_db.queries.users.add_user`
        """
        added = queries.add_user(self.session, name, password_hash, admin=admin, realm=realm)
        self.audit("user.add", added.full, admin=admin)
        return added

    def set_password(
        self, user: UserRecord, password_hash: str, *, keep_token: int | None = None
    ) -> UserRecord:
        """The user's browser sessions end, but for one that is to be kept."""
        queries.set_password(self.session, user.id, password_hash, keep_token=keep_token)
        self.audit("user.password", user.full)
        return user._replace(password_hash=password_hash)

    def set_disabled(self, user: UserRecord, disabled: bool) -> UserRecord:
        """Shut a user out, or let it in again."""
        queries.set_disabled(self.session, user.id, disabled)
        self.audit("user.disable" if disabled else "user.enable", user.full)
        return user._replace(disabled=disabled)

    def set_admin(self, user: UserRecord, admin: bool) -> UserRecord:
        """Make somebody an administrator of his realm, or no more."""
        queries.set_admin(self.session, user.id, admin)
        self.audit("user.admin", user.full, admin=admin)
        return user._replace(admin=admin)

    def add_guest(self, user: UserRecord, realm: str) -> UserRecord:
        """An account of the same person in another realm.

        :raises SwitchboardError: as :func:`relay_db.queries.sharing.add_guest`
        """
        added = queries.add_guest(self.session, user.id, realm)
        self.audit("user.join", added.full, home=added.home)
        return added

    def remove_user(self, user: UserRecord) -> None:
        """With its rights and tokens, and its accounts in other realms."""
        queries.remove_user(self.session, user.id)
        self.audit("user.remove", user.full)

    # --- groups -------------------------------------------------------------------------------------------

    def add_group(self, name: str, realm: str) -> GroupRecord:
        """:raises SwitchboardError: as :func:`relay_db.queries.users.add_group`"""
        added = queries.add_group(self.session, name, realm)
        self.audit("group.add", added.full)
        return added

    def remove_group(self, group: GroupRecord) -> None:
        """With its rights."""
        queries.remove_group(self.session, group.id)
        self.audit("group.remove", group.full)

    def join(self, group: GroupRecord, member: UserRecord) -> None:
        """Put a user into a group.

        :raises Invalid: they are of different realms
        """
        queries.add_member(self.session, group.id, member.id)
        self.audit("group.join", group.full, user=member.full)

    def leave(self, group: GroupRecord, member: UserRecord) -> bool:
        """Take a user out of a group; false if it was not in it."""
        if not queries.remove_member(self.session, group.id, member.id):
            return False
        self.audit("group.leave", group.full, user=member.full)
        return True

    # --- robots -------------------------------------------------------------------------------------------

    def add_robot(self, name: str, realm: str, description: str) -> tuple[RobotRecord, str]:
        """A robot, and the code with which it enrols.

        :raises SwitchboardError: as :func:`relay_db.queries.robots.add_robot`
        """
        added = queries.add_robot(self.session, name, description, realm)
        code = self._issue(added)
        self.audit("robot.add", added.full, description=description)
        return added, code

    def new_code(self, robot: RobotRecord) -> str:
        """A code with which it enrols anew; one that was not used yet is void."""
        code = self._issue(robot)
        self.audit("robot.code", robot.full)
        return code

    def _issue(self, robot: RobotRecord) -> str:
        code = passwords.new_enrolment_code()
        expires = self._wall() + ENROLMENT_SECONDS
        queries.issue_enrolment_code(self.session, robot.id, passwords.code_hash(code), expires)
        return code

    def remove_robot(self, robot: RobotRecord, recordings: int = 0) -> None:
        """With its keys and all rights on it.

        :param recordings: how many are kept of it, which the relay deletes then
        """
        queries.remove_robot(self.session, robot.id)
        self.audit("robot.remove", robot.full, **({"recordings": recordings} if recordings else {}))

    def share_robot(self, robot: RobotRecord, realm: str) -> None:
        """Make it one of another realm too.

        :raises SwitchboardError: as :func:`relay_db.queries.sharing.share_robot`
        """
        queries.share_robot(self.session, robot.id, realm)
        self.audit("robot.share", robot.full, realm=realm)

    def unshare_robot(self, robot: RobotRecord, realm: str) -> None:
        """Take it out of that again, with the rights on it that are held there.

        :raises SwitchboardError: as :func:`relay_db.queries.sharing.unshare_robot`
        """
        queries.unshare_robot(self.session, robot.id, realm)
        self.audit("robot.unshare", robot.full, realm=realm)

    def revoke_key(self, robot: RobotRecord, fingerprint: str) -> None:
        """Retire a key for good.

        :raises NotFound: the robot has no such live key
        """
        queries.revoke_key(self.session, robot.id, fingerprint, self._wall())
        self.audit("robot.key.revoke", robot.full, fingerprint=fingerprint)

    def describe_robot(self, robot: RobotRecord, description: str) -> RobotRecord:
        """:raises Invalid: the description can't be kept"""
        queries.describe_robot(self.session, robot.id, description)
        self.audit("robot.describe", robot.full, description=description)
        return robot._replace(description=description)

    # --- groups of robots ---------------------------------------------------------------------------------

    def fill_robot_group(self, name: str, realm: str, robots: Sequence[RobotRecord] = ()) -> RobotGroupRecord:
        """Put robots into the group of that name, which is made when there is none.

        :raises Invalid: the name can't be, or a robot is not of the realm
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

        :raises NotInGroup: one of them is not in it; then nothing must be kept of the change
        """
        for each in robots:
            if not queries.remove_from_robot_group(self.session, group.id, each.id):
                raise NotInGroup(f"{each.full} is not in group {group.full}")
        self.audit("robot.group.remove", group.full, robots=[each.full for each in robots])
        return group._replace(robots=queries.robots_of_groups(self.session, [group.id])[group.id])

    def remove_robot_group(self, group: RobotGroupRecord) -> None:
        """Its robots stay."""
        queries.remove_robot_group(self.session, group.id)
        self.audit("robot.group.remove", group.full, robots=[])

    # --- rights -------------------------------------------------------------------------------------------

    def grant(
        self, robot: RobotRecord, holder: Holder, level: str, allow: Sequence[str], deny: Sequence[str]
    ) -> None:
        """Give a right; it replaces the one the same holder has on the robot.

        :raises Invalid: a pattern that is none, too many of them, or a holder of another realm
        """
        queries.grant_right(self.session, robot.id, level, **numbers(holder), allow=allow, deny=deny)
        detail = {"level": level, "allow": list(allow), "deny": list(deny)}
        self._audit_right("right.grant", robot, holder, **detail)

    def revoke(self, robot: RobotRecord, holder: Holder) -> bool:
        """Take a right away; false if there was none."""
        if not queries.revoke_right(self.session, robot.id, **numbers(holder)):
            return False
        self._audit_right("right.revoke", robot, holder)
        return True

    def _audit_right(self, action: str, robot: RobotRecord, holder: Holder, **data: Any) -> None:
        # Long names are cut in the target, not in the data.
        whose = holder_text(holder)
        self.audit(action, f"{whose} on {robot.full}", holder=whose, robot=robot.full, **data)

    # --- tokens and programs ------------------------------------------------------------------------------

    def create_token(
        self, user: UserRecord, seconds: float, scope: str | None, label: str
    ) -> tuple[int, str]:
        """The number of a new token, and the token.

        :param scope: checked already; ``None`` for all that the user may
        :raises Invalid: the label can't be kept
        """
        secret, now = passwords.new_token(), self._wall()
        number = queries.create_token(
            self.session,
            user.id,
            passwords.token_hash(secret),
            kind="access",
            label=label,
            expires=now + seconds,
            now=now,
            scope=scope,
        )
        self.audit("token.create", user.full, id=number, ttl_s=seconds, scope=scope, label=label)
        return number, secret

    def add_program(self, user: UserRecord, scope: str | None, label: str) -> tuple[OAuthClientRecord, str]:
        """A program that acts as a user, and its secret.

        :param scope: checked already; ``None`` for all that the user may
        :raises Invalid: the user is disabled or has too many, or the label can't be kept
        """
        if user.disabled:
            raise Invalid("the user is disabled; enable it first")
        key, secret = f"swp_{secrets.token_hex(12)}", passwords.new_token()
        queries.add_program(
            self.session,
            user.id,
            key,
            passwords.verifier(key, secret),
            scope=scope,
            label=label,
            now=self._wall(),
        )
        added = queries.find_program(self.session, key)
        assert added is not None
        self.audit("program.add", user.full, id=added.id, key=key, scope=scope, label=label)
        return added, secret

    def revoke_token(self, number: int) -> bool:
        """Make a token worthless; false if there is none of that number."""
        whose = queries.user_of_token(self.session, number)
        return self._revoked("token", number, whose, queries.revoke_token(self.session, number))

    def revoke_program(self, number: int) -> bool:
        """Make a program and its tokens worthless; false if there is none of that number."""
        whose = queries.user_of_program(self.session, number)
        return self._revoked("program", number, whose, queries.remove_program(self.session, number))

    def _revoked(self, what: str, number: int, whose: str | None, done: bool) -> bool:
        if done:
            self.audit(f"{what}.revoke", str(number), user=whose)
        return done


def holder_text(holder: Holder) -> str:
    """Whom a right belongs to, as the whole relay writes it: ``toad@lab1``, ``@crew@lab1``."""
    return holder.full if isinstance(holder, UserRecord) else f"{GROUP_MARK}{holder.full}"


def numbers(holder: Holder) -> dict[str, int]:
    """The same as queries take it."""
    return {"user_id" if isinstance(holder, UserRecord) else "group_id": holder.id}
