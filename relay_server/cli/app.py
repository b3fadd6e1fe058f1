"""Shared by all commands: the data folder, the database, audited changes, names with realms, and options.

The top-level command group: it imports a command only when it is called, and turns errors into exit codes.
"""

from __future__ import annotations

import os
import pwd
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any, NamedTuple, Protocol, TypeVar

import click
from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.engine import Database
from relay_db.names import normal_name, normalise
from relay_db.queries import GroupRecord, RobotRecord, UserRecord
from relay_db.queries.realms import realm_id
from relay_protocol.command_output import OutputGroup
from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from relay_protocol.realms import DEFAULT_REALM, split_name
from relay_protocol.scopes import Scope
from relay_protocol.text import escape_unprintable
from relay_server.cli.admin_socket_client import notify_relay
from relay_server.realms.changes import AuditedChange


class LocalChange(AuditedChange):
    """A change made with ``switchboard`` on the relay's machine."""

    def __init__(self, session: Session) -> None:
        super().__init__(session, f"cli:{os_user()}", "local")

    def user(self, name: str) -> UserRecord:
        return get_user(self.session, name)

    def group(self, name: str) -> GroupRecord:
        return get_group(self.session, name)

    def robot(self, name: str) -> RobotRecord:
        return get_robot(self.session, name)


_Record = TypeVar("_Record")


class App:
    """Settings of one run of the command line.

    :param data: the data folder
    :param database_url: ``None`` for SQLite in the data folder
    """

    def __init__(self, data: Path, database_url: str | None = None) -> None:
        self.data = data
        self.given_url = database_url

    @property
    def database_url(self) -> str:
        return self.given_url or f"sqlite:///{self._file}"

    @property
    def _file(self) -> Path:
        return self.data.absolute() / "switchboard.db"

    @contextmanager
    def database(self, *, create: bool = False) -> Iterator[Database]:
        """The database, upgraded if necessary.

        :param create: whether to create the file of SQLite
        :raises Unavailable: there is no such file, or the database cannot be reached, or was written by a newer version
        """
        if not create:
            self.check_database()
        database = Database(self.database_url)
        try:
            database.upgrade()
            yield database
        finally:
            database.close()

    def check_database(self) -> None:
        """Find out whether there is a database, where that is a file.

        :raises Unavailable: there is none
        """
        if self.given_url is None and _is_missing(self._file):
            raise Unavailable(
                f"there is no database in the data folder {self.data.absolute()}; give the relay's data folder with "
                "--data, or the database with SWITCHBOARD_DB ('switchboard serve' and 'switchboard db upgrade' "
                "create one)"
            )

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """A session for queries."""
        with self.database() as database, database.reading() as session:
            yield session

    @contextmanager
    def change(self) -> Iterator[LocalChange]:
        """One change with its audit entry. A running relay is notified afterwards."""

        with self.database() as database, database.begin() as session:
            yield LocalChange(session)
        notify_relay(self.data)


def _is_missing(file: Path) -> bool:
    try:
        file.stat()
    except (FileNotFoundError, NotADirectoryError):
        return True
    except OSError:
        # Opening it says more.
        return False
    return False


def get_user(session: Session, name: str) -> UserRecord:
    """:param name: as ``toad@lab1``; a name without a realm belongs to the default realm
    :raises NotFound: no such user
    """
    return _found(queries.find_user(session, *split_name(name)), "user", name)


def user_id(session: Session, name: str | None) -> int | None:
    """The number of a user by whom a list is filtered; ``None`` for no filter.

    :raises NotFound: no such user
    """
    return None if name is None else get_user(session, name).id


def get_group(session: Session, name: str) -> GroupRecord:
    """:param name: as for :func:`get_user`
    :raises NotFound: no such group
    """
    return _found(queries.find_group(session, *split_name(name)), "group", name)


def get_robot(session: Session, name: str) -> RobotRecord:
    """:param name: as for :func:`get_user`
    :raises NotFound: no such robot
    """
    return _found(queries.find_robot(session, *split_name(name)), "robot", name)


def parse_scope(text: str | None) -> str | None:
    """The option ``--scope`` in its normal form; ``None`` for all rights of the user.

    :raises Invalid: it is not a scope
    """
    return None if text is None else str(Scope(text))


def _found(record: _Record | None, what: str, name: str) -> _Record:
    if record is None:
        raise NotFound(f"there is no {what} '{name}'; see 'switchboard {what} list'")
    return record


def os_user() -> str:
    """The name of the system's user. Environment variables are not asked, since they could be forged."""
    try:
        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        return str(os.getuid())


# --- names with realms: toad@lab1, --realm lab1 ----------------------------------------------------------


_MORE_THAN_A_NAME = frozenset("*?[:")
"""Characters of patterns and of groups of robots (``group:cleaners``)."""


class _OfRealm(Protocol):
    @property
    def realm(self) -> str: ...


_InRealm = TypeVar("_InRealm", bound=_OfRealm)


def existing_realm(session: Session, realm: str) -> str:
    """The normalised name of a realm that exists.

    :raises NotFound: there is no such realm
    """
    try:
        realm_id(session, realm)
    except NotFound:
        raise NotFound(
            f"there is no realm '{realm}'; see 'switchboard realm list', or add it with 'switchboard realm add'"
        ) from None
    return normalise(realm)


def new_name(session: Session, text: str) -> tuple[str, str]:
    """The name and the realm of something new.

    :raises NotFound: there is no such realm
    """
    name, realm = split_name(text)
    return name, existing_realm(session, realm)


def list_in_realm(
    session: Session, query: Callable[[Session, str | None], Iterable[_InRealm]], realm: str | None
) -> list[_InRealm]:
    """The results of a query for one realm, or for all: the default realm first.

    :raises NotFound: there is no such realm
    """
    found = query(session, None if realm is None else existing_realm(session, realm))
    return sorted(found, key=lambda each: (each.realm != DEFAULT_REALM, each.realm))


def resolve_realm(asked: Sequence[str], realm: str | None = None) -> tuple[str, list[str]]:
    """The realm that all names of one request belong to, and the names without it.

    :param asked: names, patterns, ``group:NAME``; a name may have its realm: ``mobile@lab2``
    :param realm: the option ``--realm``; by default names without a realm belong to the default realm
    :raises Invalid: they belong to several realms, a pattern or a group names one, or a realm's name is not
        valid
    """
    wanted = DEFAULT_REALM if realm is None else _realm(realm)
    realms = set() if realm is None else {wanted}
    names = []
    for each in asked:
        name, at, _ = each.partition("@")
        if at and not _MORE_THAN_A_NAME.isdisjoint(name):
            raise Invalid(
                f"'{each}' is not the name of one robot; write '{name}' and give its realm by --realm"
            )
        realms.add(_realm(split_name(each)[1]) if at else wanted)
        names.append(name)
    if len(realms) > 1:
        several = " and ".join(f"'{each}'" for each in sorted(realms))
        raise Invalid(f"these belong to the realms {several}; name one realm at a time")
    return next(iter(realms), wanted), names


def _realm(name: str) -> str:
    return normal_name(name, "name of a realm")


# --- options ----------------------------------------------------------------------------------------------


pass_app = click.make_pass_decorator(App)

json_option: Callable[[Any], Any] = click.option(
    "--json", "as_json", is_flag=True, help="Print only JSON to stdout."
)
why_option: Callable[[Any], Any] = click.option(
    "--why",
    default="",
    # An order to stop must not fail because its reason is not UTF-8.
    callback=lambda _context, _option, why: why.encode("utf-8", "replace").decode(),
    help="The reason, for other users and the audit log.",
)
number_argument: Callable[[Any], Any] = click.argument(
    "number", metavar="ID", type=click.IntRange(min=1, max=2**31 - 1)
)
realm_option: Callable[[Any], Any] = click.option("--realm", metavar="NAME", help="Only of this realm.")

one_realm_option: Callable[[Any], Any] = click.option(
    "--realm", metavar="NAME", help="In this realm instead of the default one."
)
yes_option: Callable[[Any], Any] = click.option("--yes", is_flag=True, help="Don't ask.")


def confirm(question: str, yes: bool) -> None:
    """Ask before a change that cannot be undone. The question goes to stderr."""
    if not yes:
        click.confirm(question, abort=True, err=True)


def examples(*lines: str) -> str:
    """An epilog with examples, not wrapped, and the meaning of the exit codes."""
    body = "\n".join(f"  {line}" for line in lines)
    return f"\b\nExamples:\n{body}\n\n{EXIT_CODES}"


EXIT_CODES = (
    "Exit codes: 0 done, 1 refused or failed (stderr says why), 2 wrong usage, "
    "3 the relay or the database cannot be reached."
)

REFUSED = 1
UNREACHABLE = 3


class Failure(click.ClickException):
    """Ends a command that was refused or failed."""

    exit_code = REFUSED

    @staticmethod
    def of(error: SwitchboardError) -> Failure:
        return Unreachable(str(error)) if isinstance(error, Unavailable) else Failure(str(error))

    def show(self, file: IO[Any] | None = None) -> None:
        click.echo(f"Error: {escape_unprintable(self.message)}", file=file, err=file is None)


class Unreachable(Failure):
    """Ends a command because the relay or the database cannot be reached."""

    exit_code = UNREACHABLE


class CommandEntry(NamedTuple):
    """The module of a command, its name there, and its line in the help."""

    module: str
    name: str
    help: str


def _add_shared_options(command: click.Command) -> None:
    """Let ``--data`` and ``--db`` stand behind a command too, unless it has an option of that name."""
    if isinstance(command, click.Group):
        for each in command.commands.values():
            _add_shared_options(each)
        return
    own = {name for parameter in command.params for name in parameter.opts}
    for option in _shared_options():
        if own.isdisjoint(option.opts):
            command.params.append(option)


def _shared_options() -> Iterator[click.Option]:
    def set_data(context: click.Context, _option: click.Parameter, data: Path | None) -> None:
        app = context.find_object(App)
        if data is not None and app is not None:
            app.data = data.expanduser()

    def set_database(context: click.Context, _option: click.Parameter, url: str | None) -> None:
        app = context.find_object(App)
        if url is not None and app is not None:
            app.given_url = url

    folder = click.Path(file_okay=False, path_type=Path)
    # The help of the command as a whole has them.
    yield click.Option(["--data"], type=folder, callback=set_data, expose_value=False, hidden=True)
    yield click.Option(["--db"], callback=set_database, expose_value=False, hidden=True)


class LazyGroup(OutputGroup):
    """The options of the group may also stand behind a command.

    :param entries: commands by name, in the order of the help; entries whose module does not exist are
        left out
    """

    def __init__(self, *args: Any, entries: Mapping[str, CommandEntry], **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._entries = {name: entry for name, entry in entries.items() if find_spec(entry.module)}

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self._entries)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        entry = self._entries.get(cmd_name)
        if entry is None:
            return None
        command = getattr(import_module(entry.module), entry.name)
        assert isinstance(command, click.Command)
        _add_shared_options(command)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, entry.help) for name, entry in self._entries.items()])

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command; an error of the product becomes a sentence and an exit code."""
        try:
            return super().invoke(ctx)
        except SwitchboardError as error:
            raise Failure.of(error) from error
        except ModuleNotFoundError as error:
            if (error.name or "").startswith(("relay_", "robot_")):
                raise
            raise Failure(
                f"this command needs the server's packages ({error.name} is missing): install the extra 'server'"
            ) from error
