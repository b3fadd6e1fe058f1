"""``switchboard role``: Roles of a realm as documents, and queries over them."""

from __future__ import annotations

import json
import signal
import time
from pathlib import Path
from typing import Any

import click
from sqlalchemy.orm import Session

from relay_db import queries
from relay_protocol.errors import Invalid, NotFound
from relay_protocol.realms import DEFAULT_REALM
from relay_server.cli.admin_socket_client import send_order
from relay_server.cli.app import (
    App,
    confirm,
    examples,
    existing_realm,
    json_option,
    one_realm_option,
    os_user,
    pass_app,
    yes_option,
)
from relay_server.cli.output import format_time, print_json, print_line, print_list, print_note, print_result
from relay_server.roles.documents import load, write
from relay_server.roles.service import check_not_started, iri_of, store
from relay_server.roles.sparql import RESULTS_CSV, RESULTS_JSON, TURTLE, RoleGraphs

_ENDINGS = {
    ".rdf": "application/rdf+xml",
    ".xml": "application/rdf+xml",
    ".owl": "application/rdf+xml",
    ".ttl": "text/turtle",
    ".jsonld": "application/ld+json",
}


@click.group(
    epilog=examples(
        "switchboard role load gamepad.rdf",
        "switchboard role list --element AXIS_0",
        "switchboard role query 'SELECT ?port WHERE { ?process fierro:port ?port }'",
    )
)
def role() -> None:
    """Load, show, save, query and remove Roles.

    A Role says in RDF which elements of which robots work together: subject, action and object.
    """


@role.command("list", epilog=examples("switchboard role list", "switchboard role list --element AXIS_0"))
@click.option("--element", help="Only Roles that this element belongs to, itself or by mappings.")
@one_realm_option
@json_option
@pass_app
def list_roles(app: App, element: str | None, realm: str | None, as_json: bool) -> None:
    """List the Roles of a realm."""
    with app.reading() as session:
        where = existing_realm(session, realm or DEFAULT_REALM)
        found = queries.list_roles(session, where)
        if element is not None:
            names = _graphs(session, where).roles_of(iri_of(element), None) or []
            found = [each for each in found if each.name in names]
    cells = (
        (
            each.name,
            str(each.revision),
            str(each.statements),
            " ".join(each.robots),
            each.by,
            format_time(each.at),
        )
        for each in found
    )
    columns = ("role", "revision", "statements", "robots", "changed by", "changed")
    print_list(as_json, map(_json, found), columns, cells)


@role.command(
    "load", epilog=examples("switchboard role load gamepad.rdf", "switchboard role load a.ttl b.jsonld")
)
@click.argument(
    "files", nargs=-1, required=True, type=click.Path(exists=True, dir_okay=False, path_type=Path)
)
@one_realm_option
@json_option
@pass_app
def load_roles(app: App, files: tuple[Path, ...], realm: str | None, as_json: bool) -> None:
    """Load all Roles of FILES. Each is added, or replaces the one of its name.

    The end of a file's name says its form: .rdf (RDF/XML), .ttl (Turtle), .jsonld (JSON-LD).
    """
    loaded = [each for file in files for each in load(file.read_bytes(), _media(file))]
    with app.change() as change:
        where, stored = existing_realm(change.session, realm or DEFAULT_REALM), []
        for each in loaded:
            actor = f"cli:{os_user()}"
            record = store(change.session, where, each, None, actor, time.time())
            queries.append_audit(
                change.session,
                at=record.at,
                actor=actor,
                action="role.save",
                target=f"{each.name}@{where}",
                origin="local",
                data={"revision": record.revision},
            )
            stored.append(record)
    for each in loaded:
        for note in each.notes:
            print_note(note)
    print_result(as_json, [_json(each) for each in stored], *(f"{each.name}: loaded." for each in stored))


@role.command("show", epilog=examples("switchboard role show GamePad-Drive-Motors"))
@click.argument("name")
@one_realm_option
@json_option
@pass_app
def show(app: App, name: str, realm: str | None, as_json: bool) -> None:
    """Show Role NAME in Turtle."""
    text = _written(app, [name], realm, "text/turtle")
    if as_json:
        print_json({"name": name, "turtle": text.decode()})
    else:
        _print_text(text)


@role.command("save", epilog=examples("switchboard role save GamePad-Drive-Motors -o gamepad.rdf"))
@click.argument("names", nargs=-1, required=True)
@click.option(
    "-o", "--output", required=True, type=click.Path(dir_okay=False, path_type=Path), help="File to write."
)
@one_realm_option
@json_option
@pass_app
def save(app: App, names: tuple[str, ...], output: Path, realm: str | None, as_json: bool) -> None:
    """Save Roles NAMES into one file, in the form that the end of its name says."""
    output.write_bytes(_written(app, names, realm, _media(output)))
    answer = {"roles": list(names), "file": str(output)}
    print_result(as_json, answer, f"{', '.join(names)}: saved as {output}.")


@role.command("remove", epilog=examples("switchboard role remove GamePad-Drive-Motors"))
@click.argument("name")
@one_realm_option
@yes_option
@json_option
@pass_app
def remove(app: App, name: str, realm: str | None, yes: bool, as_json: bool) -> None:
    """Remove Role NAME."""
    confirm(f"Remove Role {name}?", yes)
    with app.change() as change:
        where = existing_realm(change.session, realm or DEFAULT_REALM)
        check_not_started(change.session, where, name)
        if not queries.remove_role(change.session, where, name):
            raise _no_role(name)
        queries.append_audit(
            change.session,
            at=time.time(),
            actor=f"cli:{os_user()}",
            action="role.remove",
            target=f"{name}@{where}",
            origin="local",
        )
    print_result(as_json, {"role": name, "removed": True}, f"{name}: removed.")


@role.command(
    "query", epilog=examples("switchboard role query 'SELECT ?port WHERE { ?process fierro:port ?port }'")
)
@click.argument("sparql")
@one_realm_option
@json_option
@pass_app
def query(app: App, sparql: str, realm: str | None, as_json: bool) -> None:
    """Query the Roles of a realm with SPARQL. Results are in CSV, those of CONSTRUCT in Turtle."""
    # Oxigraph does not end by Python's handler of Ctrl-C.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    with app.reading() as session:
        graphs = _graphs(session, existing_realm(session, realm or DEFAULT_REALM))
    _print_text(graphs.query(sparql, None, RESULTS_JSON if as_json else RESULTS_CSV, TURTLE)[1])


_user_option = click.option("--user", required=True, help="User by whose rights it is done.")


@role.command("get", epilog=examples("switchboard role get GamePad-Drive-Motors AXIS_0 --user ann"))
@click.argument("name")
@click.argument("element")
@_user_option
@json_option
@pass_app
def get(app: App, name: str, element: str, user: str, as_json: bool) -> None:
    """Print the value of ELEMENT of Role NAME, as JSON."""
    answer = _command(app, "get", name, element, user)
    print_result(as_json, answer, json.dumps(answer["value"], ensure_ascii=False))


@role.command("set", epilog=examples("switchboard role set Home-Light-Lamp POWER true --user ann"))
@click.argument("name")
@click.argument("element")
@click.argument("value")
@_user_option
@json_option
@pass_app
def set_value(app: App, name: str, element: str, value: str, user: str, as_json: bool) -> None:
    """Set ELEMENT of Role NAME to VALUE: JSON, or a text."""
    answer = _command(app, "set", name, element, user, value=_json_or_text(value))
    print_result(as_json, answer, f"{element}: sent to {answer['resource']}.")


@role.command("call", epilog=examples("switchboard role call Robot-Speak-Voice SAY --user ann"))
@click.argument("name")
@click.argument("element")
@click.argument("args", default="{}")
@_user_option
@json_option
@pass_app
def call(app: App, name: str, element: str, args: str, user: str, as_json: bool) -> None:
    """Call ELEMENT of Role NAME with ARGS, a JSON object."""
    answer = _command(app, "call", name, element, user, args=_json_or_text(args))
    print_result(as_json, answer, json.dumps(answer["values"], ensure_ascii=False))


@role.command(
    "start",
    epilog=examples(
        "switchboard role start GamePad-Drive-Motors --user ann",
        "switchboard role start GamePad-Drive-Motors GamePadX --user ann",
    ),
)
@click.argument("name")
@click.argument("element", default="")
@_user_option
@json_option
@pass_app
def start(app: App, name: str, element: str, user: str, as_json: bool) -> None:
    """Start Role NAME: its modules, devices and pipes; or the one that is ELEMENT of it."""
    _print_switched(as_json, element, _command(app, "start", name, element, user))


@role.command(
    "stop",
    epilog=examples(
        "switchboard role stop GamePad-Drive-Motors --user ann",
        "switchboard role stop GamePad-Drive-Motors GamePadX --user ann",
    ),
)
@click.argument("name")
@click.argument("element", default="")
@_user_option
@json_option
@pass_app
def stop(app: App, name: str, element: str, user: str, as_json: bool) -> None:
    """Stop Role NAME: its pipes, devices and modules; or the one that is ELEMENT of it."""
    _print_switched(as_json, element, _command(app, "stop", name, element, user))


@role.command("state", epilog=examples("switchboard role state GamePad-Drive-Motors --user ann"))
@click.argument("name")
@_user_option
@json_option
@pass_app
def state(app: App, name: str, user: str, as_json: bool) -> None:
    """Show whether Role NAME is started, and the state of its parts."""
    _print_run(as_json, _command(app, "state", name, "", user))


def _command(app: App, do: str, name: str, element: str, user: str, **more: Any) -> dict[str, Any]:
    """:raises SwitchboardError: no relay runs here, or it refuses"""
    return send_order(app.data, "roles", {"user": user, "do": do, "role": name, "element": element, **more})


def _print_run(as_json: bool, answer: dict[str, Any]) -> None:
    why = f": {answer['why']}" if answer["why"] else ""
    parts = [
        f"  {each['element']}: {each['resource']} {each['state']}"
        + (f" ({each['why']})" if each["why"] else "")
        for each in answer["parts"]
    ]
    print_result(as_json, answer, f"{answer['role']}: {answer['state']}{why}.", *parts)


def _print_switched(as_json: bool, element: str, answer: dict[str, Any]) -> None:
    if not element:
        _print_run(as_json, answer)
        return
    state = f": {answer['state']}" if answer["state"] else ""
    print_result(as_json, answer, f"{element}: {answer['command']} of {answer['resource']}{state}.")


def _json_or_text(value: str) -> Any:
    try:
        return json.loads(value)
    except ValueError:
        return value


def _print_text(text: bytes) -> None:
    for line in text.decode().splitlines():
        print_line(line)


def _graphs(session: Session, realm: str) -> RoleGraphs:
    graphs = RoleGraphs()
    names = [each.name for each in queries.list_roles(session, realm)]
    for start in range(0, len(names), 100):
        for name, document in queries.role_documents(session, realm, names[start : start + 100]):
            graphs.put(name, document)
    return graphs


def _written(app: App, names: Any, realm: str | None, media: str) -> bytes:
    with app.reading() as session:
        found = dict(
            queries.role_documents(session, existing_realm(session, realm or DEFAULT_REALM), list(names))
        )
    for name in names:
        if name not in found:
            raise _no_role(name)
    return write(found.values(), media)


def _no_role(name: str) -> NotFound:
    return NotFound(f"there is no Role '{name}'; see 'switchboard role list'")


def _media(file: Path) -> str:
    try:
        return _ENDINGS[file.suffix.lower()]
    except KeyError:
        raise Invalid(
            f"the form of '{file.name}' is not known; its name must end with {', '.join(_ENDINGS)}"
        ) from None


def _json(record: queries.RoleRecord) -> dict[str, Any]:
    return {
        "name": record.name,
        "revision": record.revision,
        "statements": record.statements,
        "robots": record.robots,
        "by": record.by,
        "at": record.at,
    }
