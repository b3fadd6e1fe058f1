"""What every command gets: where the data is, the database, and the one way to change something in it."""

from __future__ import annotations

import os
import pwd
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from sqlalchemy.orm import Session

from relay_db.queries import GroupRecord, RobotRecord, UserRecord
from relay_protocol.errors import NotFound
from relay_protocol.realms import parted
from relay_server.cli.control_socket import notify_relay
from relay_server.realms.changes import AuditedChange

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

    from relay_db.engine import Database
    from relay_db.queries import GroupRecord, RobotRecord, UserRecord


class LocalChange(AuditedChange):
    """A change by who may run ``switchboard`` on the relay's machine."""

    def __init__(self, session: Session) -> None:
        super().__init__(session, f"cli:{os_user()}", "local")

    def user(self, name: str) -> UserRecord:
        """:raises NotFound: no such user"""
        return user_of(self.session, name)

    def group(self, name: str) -> GroupRecord:
        """:raises NotFound: no such group"""
        return group_of(self.session, name)

    def robot(self, name: str) -> RobotRecord:
        """:raises NotFound: no such robot"""
        return robot_of(self.session, name)


_Record = TypeVar("_Record")


class App:
    """Settings of one run of the command line.

    :param data: the data folder
    :param database_url: None for SQLite in the data folder
    """

    def __init__(self, data: Path, database_url: str | None = None) -> None:
        self.data = data
        self._url = database_url

    @property
    def database_url(self) -> str:
        """Of the database to use."""
        return self._url or f"sqlite:///{self.data.absolute() / 'switchboard.db'}"

    @contextmanager
    def database(self) -> Iterator[Database]:
        """The database, created and brought up to date if need be.

        :raises Unavailable: it can't be reached, or was written by newer code
        """
        from relay_db.engine import Database

        database = Database(self.database_url)
        try:
            database.upgrade()
            yield database
        finally:
            database.close()

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """A session to look things up with."""
        with self.database() as database, database.reading() as session:
            yield session

    @contextmanager
    def change(self) -> Iterator[LocalChange]:
        """One change with its audit entry; afterwards a running relay is told to look."""

        with self.database() as database, database.begin() as session:
            yield LocalChange(session)
        notify_relay(self.data)


def user_of(session: Session, name: str) -> UserRecord:
    """:param name: as ``toad@lab1``; without a realm one of the default one
    :raises NotFound: no such user"""
    from relay_db import queries

    return _found(queries.find_user(session, *parted(name)), "user", name)


def group_of(session: Session, name: str) -> GroupRecord:
    """:param name: as of :func:`user_of`
    :raises NotFound: no such group"""
    from relay_db import queries

    return _found(queries.find_group(session, *parted(name)), "group", name)


def robot_of(session: Session, name: str) -> RobotRecord:
    """:param name: as of :func:`user_of`
    :raises NotFound: no such robot"""
    from relay_db import queries

    return _found(queries.find_robot(session, *parted(name)), "robot", name)


def _found(record: _Record | None, what: str, name: str) -> _Record:
    if record is None:
        raise NotFound(f"there is no {what} '{name}'; see 'switchboard {what} list'")
    return record


def os_user() -> str:
    """Who runs this, by the system's own account of it; environment variables could say anything."""
    try:
        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        return str(os.getuid())


pass_app = click.make_pass_decorator(App)

json_option: Callable[[Any], Any] = click.option(
    "--json", "as_json", is_flag=True, help="Print JSON, and nothing else, to stdout."
)
why_option: Callable[[Any], Any] = click.option(
    "--why",
    default="",
    # What is no UTF-8 must not keep an order to stop from being understood.
    callback=lambda _context, _option, why: why.encode("utf-8", "replace").decode(),
    help="The reason, for the others and for the record.",
)
yes_option: Callable[[Any], Any] = click.option("--yes", is_flag=True, help="Don't ask.")


def sure(question: str, yes: bool) -> None:
    """Ask before something that can't be undone; the question goes to stderr."""
    if not yes:
        click.confirm(question, abort=True, err=True)


def examples(*lines: str) -> str:
    """An epilog of examples, not re-wrapped, with what the exit codes mean."""
    body = "\n".join(f"  {line}" for line in lines)
    return f"\b\nExamples:\n{body}\n\n{EXIT_CODES}"


EXIT_CODES = (
    "Exit codes: 0 done, 1 refused or failed (a sentence on stderr says why), 2 wrong usage, "
    "3 the relay or the database can't be reached."
)
