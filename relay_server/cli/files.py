"""``switchboard file``: files of robots at the relay, in the data folder or a storage. A running relay is not asked."""

from __future__ import annotations

import time
from pathlib import Path

import click

from relay_db import queries
from relay_db.queries import FileQuotas, NewFile
from relay_protocol.errors import Unavailable
from relay_protocol.limits import MIB
from relay_server.cli.app import App, confirm, examples, get_robot, json_option, os_user, pass_app, yes_option
from relay_server.cli.output import format_size, format_time, print_list, print_result
from relay_server.files.build import FOLDER, open_storage
from relay_server.files.incoming import IncomingFolder
from relay_server.files.storage import FileStorage
from relay_server.files.uploads import check_file_name

STORAGE = "switchboard.files.storage"
"""Key of the storage's URL in the context of a command."""
_NO_QUOTA = FileQuotas(2**62, 2**62, 2**62)
"""An administrator of the machine is not bounded by the quotas of robots."""


@click.group(
    epilog=examples(
        "switchboard file list rover",
        "switchboard file get rover bags/run1.mcap --output run1.mcap",
        "switchboard file put rover map.yaml --name maps/hall.yaml",
        "switchboard file remove rover bags/run1.mcap",
    )
)
@click.option(
    "--storage",
    envvar="SWITCHBOARD_FILES_STORAGE",
    show_envvar=True,
    default="",
    metavar="URL",
    help="S3-compatible storage, as of 'switchboard serve --files-storage'.",
)
@click.pass_context
def file(context: click.Context, storage: str) -> None:
    """List, read, add and remove files of a robot that are at the relay."""
    context.meta[STORAGE] = storage


def _storage(app: App) -> FileStorage:
    """:raises Invalid: the URL of the storage can't be used"""
    return open_storage(app.data / FOLDER, click.get_current_context().meta[STORAGE])


@file.command("list", epilog=examples("switchboard file list rover --prefix bags/"))
@click.argument("robot")
@click.option("--prefix", default="", help="Only files whose names begin so.")
@click.option("--limit", default=1000, show_default=True, type=click.IntRange(1, 1_000_000))
@json_option
@pass_app
def list_(app: App, robot: str, prefix: str, limit: int, as_json: bool) -> None:
    """List the files of ROBOT by name."""
    with app.reading() as session:
        found = queries.list_files(session, get_robot(session, robot).id, prefix, None, limit)
    cells = (
        (each.name, format_size(each.size), each.origin, format_time(each.state_since), each.sha256[:12])
        for each in found
    )
    shown = (
        {"name": each.name, "size": each.size, "sha256": each.sha256, "origin": each.origin}
        | {"modified": each.modified, "stored": each.state_since}
        for each in found
    )
    print_list(as_json, shown, ("name", "size", "origin", "stored", "SHA-256"), cells)


@file.command("get", epilog=examples("switchboard file get rover maps/hall.yaml --output hall.yaml"))
@click.argument("robot")
@click.argument("name")
@click.option(
    "--output",
    type=click.Path(dir_okay=False, path_type=Path),
    required=True,
    help="File to write.",
)
@json_option
@pass_app
def get(app: App, robot: str, name: str, output: Path, as_json: bool) -> None:
    """Read the file NAME of ROBOT; of several of this name, the one that was stored last."""
    with app.reading() as session:
        found = queries.find_file(session, get_robot(session, robot).id, name)
    try:
        content = _storage(app).open(str(found.id))
        try:
            with output.open("wb") as target:
                offset = 0
                while part := content.read(offset, MIB):
                    target.write(part)
                    offset += len(part)
        finally:
            content.close()
    except OSError as error:
        raise Unavailable(f"the file can't be copied: {error.strerror}") from None
    answer = {"name": name, "size": found.size, "sha256": found.sha256}
    print_result(as_json, answer, f"{output} has {format_size(found.size)}.")


@file.command("put", epilog=examples("switchboard file put rover map.yaml --name maps/hall.yaml"))
@click.argument("robot")
@click.argument("source", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--name", default="", help="Name at the relay; by default that of the file.")
@json_option
@pass_app
def put(app: App, robot: str, source: Path, name: str, as_json: bool) -> None:
    """Add the file SOURCE to the files of ROBOT."""
    name = name or source.name
    check_file_name(name)
    storage = _storage(app)
    incoming = IncomingFolder(app.data / FOLDER / "incoming", storage, 0)
    try:
        incoming.prepare()
        sha256, size = incoming.hash_of(source)
        new = NewFile(name, sha256, size, f"cli:{os_user()}", source.stat().st_mtime)
        with app.change() as change:
            record = change.robot(robot)
            found = queries.add_file(change.session, record.id, new, _NO_QUOTA, time.time())
            change.audit("file.put", record.full, file=name, sha256=sha256, bytes=size)
        if found.state != "stored":
            incoming.copy(source, storage, str(found.id), size, sha256)
            with app.database() as database, database.begin() as session:
                queries.file_stored(session, found.id, time.time())
    except OSError as error:
        raise Unavailable(f"the file can't be copied: {error.strerror or error}") from None
    print_result(as_json, {"name": name, "size": size, "sha256": sha256}, f"{name} has {format_size(size)}.")


@file.command("remove", epilog=examples("switchboard file remove rover bags/run1.mcap --yes"))
@click.argument("robot")
@click.argument("name")
@yes_option
@json_option
@pass_app
def remove(app: App, robot: str, name: str, yes: bool, as_json: bool) -> None:
    """Remove all files of ROBOT with this NAME."""
    with app.reading() as session:
        found = queries.files_named(session, get_robot(session, robot).id, name)
    if not found:
        raise Unavailable(queries.NO_FILE)
    confirm(f"Remove {name} of {robot}?", yes)
    with app.change() as change:
        for each in found:
            queries.begin_file_removal(change.session, each.id, time.time())
            change.audit("file.delete", change.robot(robot).full, file=name, sha256=each.sha256)
    storage = _storage(app)
    incoming = IncomingFolder(app.data / FOLDER / "incoming", storage, 0)
    try:
        for each in found:
            storage.delete(str(each.id))
            incoming.delete(str(each.id))
    except OSError as error:
        raise Unavailable(f"the file can't be deleted yet: {error.strerror}") from None
    with app.database() as database, database.begin() as session:
        for each in found:
            queries.remove_file(session, each.id)
    print_result(as_json, {"removed": len(found)}, f"{name} is removed.")
