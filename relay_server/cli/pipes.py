"""``switchboard pipe``: topics that are carried from robot to robot."""

from __future__ import annotations

import json
import re
from typing import Any

import click

from relay_protocol.errors import Invalid
from relay_server.cli.admin_socket_client import send_order
from relay_server.cli.app import App, confirm, examples, json_option, os_user, pass_app, yes_option
from relay_server.cli.output import print_json, print_line, print_result, print_table

_COLUMNS = ("pipe", "owner", "from", "to", "state", "messages", "drops", "latency", "why")
_NONE = "–"
_NUMBER = r"[-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?"
_MARKS = {"()": "service", "{}": "action"}
_PROGRAM = re.compile(r"programs/(?P<program>\w+)/(?P<kind>port|function)s/(?P<name>\w+)\Z")
_FIELD = re.compile(rf"([^=]+)=([^=*+]+?)(?:\*({_NUMBER}))?(?:\+({_NUMBER}))?\Z")


@click.group(
    epilog=examples(
        "switchboard pipe add scan-copy one:/scan two:/scan --owner ann",
        "switchboard pipe list",
        "switchboard pipe stop scan-copy",
    )
)
def pipe() -> None:
    """Carry topics from robot to robot: whole messages, or values of fields.

    A pipe runs by the rights of its owner, and ends when they end. Pipes of other realms are named as scan-copy@lab1.
    """


@pipe.command("list", epilog=examples("switchboard pipe list", "switchboard pipe list --json"))
@json_option
@pass_app
def list_pipes(app: App, as_json: bool) -> None:
    """List all pipes, with their states and figures."""
    answer = _ask(app, "list")
    if as_json:
        print_json(answer)
    elif not answer["pipes"]:
        print_line("There are no pipes; add one with 'switchboard pipe add'.")
    else:
        print_table(_COLUMNS, [_row(each) for each in answer["pipes"]])


@pipe.command("show", epilog=examples("switchboard pipe show scan-copy"))
@click.argument("name")
@json_option
@pass_app
def show(app: App, name: str, as_json: bool) -> None:
    """Show the pipe NAME."""
    answer = _ask(app, "show", pipe=name)
    if as_json:
        print_json(answer)
        return
    for column, value in zip(_COLUMNS, _row(answer), strict=True):
        print_line(f"{column:<10}{value}")
    print_line(f"{'rate':<10}{answer['rate'] or 'all messages'}")
    for each in answer["fields"]:
        print_line(f"{'field':<10}{each['source']} → {each['target']}")


@pipe.command(
    "add",
    epilog=examples(
        "switchboard pipe add scan-copy one:/scan two:/scan --owner ann",
        "switchboard pipe add drive pad:/joy rover:/cmd_vel --owner ann --field 'axes[1]=linear.x*0.5'",
        "switchboard pipe add lamp door:/open 'home:/lamp/switch()' --owner ann --field data=data",
    ),
)
@click.argument("name")
@click.argument("source")
@click.argument("target")
@click.option("--owner", required=True, help="User by whose rights it runs.")
@click.option("--source-type", default="", help="Type of a source topic that no node has yet.")
@click.option("--target-type", default="", help="Type of a target topic that no node has yet.")
@click.option(
    "--field",
    "fields",
    multiple=True,
    metavar="FROM=TO[*SCALE][+OFFSET]",
    help="Carry a value of a field, instead of whole messages. Repeat for more.",
)
@click.option(
    "--table",
    "tables",
    multiple=True,
    metavar="TO=JSON",
    help='Values of a field by those of its source, as \'lamp={"on": true, "off": false}\'.',
)
@click.option("--rate", type=click.FloatRange(0, 10_000), default=0, help="Most messages a second.")
@click.option("--stopped", is_flag=True, help="Do not start it.")
@json_option
@pass_app
def add(
    app: App, /, name: str, source: str, target: str, fields: tuple[str, ...], tables: tuple[str, ...],
    as_json: bool, **more: Any,
) -> None:  # fmt: skip
    """Add the pipe NAME from SOURCE to TARGET, each written as ROBOT:/TOPIC, ROBOT:/SERVICE() or ROBOT:/ACTION{}.

    An end may be a program of the owner: programs/PROGRAM/ports/PORT or programs/PROGRAM/functions/FUNCTION.
    """
    new = {
        "name": name,
        "source": {**_end(source), "type": more["source_type"]},
        "target": {**_end(target), "type": more["target_type"]},
        "fields": _fields(fields, tables),
        "rate": more["rate"],
        "start": not more["stopped"],
    }
    _print_state(as_json, _ask(app, "add", new=new, owner=more["owner"]))


@pipe.command("start", epilog=examples("switchboard pipe start scan-copy"))
@click.argument("name")
@json_option
@pass_app
def start(app: App, name: str, as_json: bool) -> None:
    """Start the pipe NAME, by the rights of its owner."""
    _print_state(as_json, _ask(app, "start", pipe=name))


@pipe.command("stop", epilog=examples("switchboard pipe stop scan-copy"))
@click.argument("name")
@json_option
@pass_app
def stop(app: App, name: str, as_json: bool) -> None:
    """Stop the pipe NAME."""
    _print_state(as_json, _ask(app, "stop", pipe=name))


@pipe.command("remove", epilog=examples("switchboard pipe remove scan-copy --yes"))
@click.argument("name")
@yes_option
@json_option
@pass_app
def remove(app: App, name: str, yes: bool, as_json: bool) -> None:
    """Stop and remove the pipe NAME."""
    confirm(f"Remove the pipe {name}?", yes)
    print_result(as_json, _ask(app, "remove", pipe=name), f"Pipe {name} is removed.")


def _ask(app: App, do: str, **more: Any) -> dict[str, Any]:
    """:raises SwitchboardError: no relay runs here, or it refuses"""
    return send_order(app.data, "pipes", {"by": os_user(), "do": do, **more})


def _print_state(as_json: bool, answer: dict[str, Any]) -> None:
    why = f": {answer['why']}" if answer["why"] else ""
    print_result(as_json, answer, f"Pipe {answer['name']} is {answer['state']}{why}.")


def _end(text: str) -> dict[str, str]:
    """:raises Invalid: it is not written as an end"""
    program = _PROGRAM.match(text)
    if program is not None:
        return {"program": program["program"], program["kind"]: program["name"]}
    robot, colon, name = text.partition(":")
    if not (robot and colon and name.startswith("/")):
        raise Invalid(
            f"'{text}' is no end of a pipe; write ROBOT:/TOPIC, as 'one:/scan', ROBOT:/SERVICE(), as 'one:/light()', "
            "ROBOT:/ACTION{}, as 'one:/dock{}', "
            "or programs/PROGRAM/ports/PORT or programs/PROGRAM/functions/FUNCTION"
        )
    for mark, kind in _MARKS.items():
        if name.endswith(mark):
            return {"robot": robot, kind: name.removesuffix(mark)}
    return {"robot": robot, "topic": name}


def _fields(fields: tuple[str, ...], tables: tuple[str, ...]) -> list[dict[str, Any]]:
    """:raises Invalid: a field or a table can't be read"""
    by_target = dict(_table(each) for each in tables)
    found = []
    for text in fields:
        match = _FIELD.match(text)
        if match is None:
            raise Invalid(f"'{text}' is no field to carry; write FROM=TO, as 'axes[1]=linear.x*0.5'")
        source, target, scale, offset = match.groups()
        found.append(
            {
                "source": source,
                "target": target,
                "scale": float(scale or 1),
                "offset": float(offset or 0),
                "table": by_target.pop(target, {}),
            }
        )
    if by_target:
        raise Invalid(f"there is no --field to '{next(iter(by_target))}', for which there is a --table")
    return found


def _table(text: str) -> tuple[str, dict[str, Any]]:
    target, _, table = text.partition("=")
    try:
        decoded = json.loads(table)
    except ValueError:
        decoded = None
    if not isinstance(decoded, dict):
        raise Invalid(f"'{text}' is no table; write TO=JSON, as 'lamp={{\"on\": true}}'")
    return target, decoded


def _end_text(end: dict[str, str]) -> str:
    if end["program"]:
        kind = "port" if end["port"] else "function"
        return f"programs/{end['program']}/{kind}s/{end[kind]}"
    marked = [f"{end[kind]}{mark}" for mark, kind in _MARKS.items() if end[kind]]
    return f"{end['robot']}:{''.join(marked) or end['topic']}"


def _row(pipe: dict[str, Any]) -> tuple[str, ...]:
    latency = pipe["latency_ms"]
    return (
        pipe["name"],
        pipe["owner"],
        _end_text(pipe["source"]),
        _end_text(pipe["target"]),
        pipe["state"],
        str(pipe["messages"]),
        str(pipe["drops"]),
        _NONE if latency is None else f"{latency:g} ms",
        pipe["why"] or _NONE,
    )
