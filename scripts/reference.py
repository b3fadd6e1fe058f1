"""Write the pages of ``docs/reference`` that follow from the code: ``make reference``.

With ``--check`` nothing is written; pages that are missing or stale are named, and the exit code is 1.
"""

from __future__ import annotations

import ast
import configparser
import re
import sys
import textwrap
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import click
import msgspec

import relay_server
from relay_protocol import limits
from relay_protocol.realms import DEFAULT_REALM
from relay_server.http.openapi.document import document
from relay_server.http.openapi.http import operations
from robot_client import config

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "docs/reference"
WIDTH = 100
NOTE = "<!-- Written by scripts/reference.py from the code; change the code, then run `make reference`. -->"
APPS = ("collision_avoidance", "greeting", "joystick", "recharge", "voice")
METHODS = ("get", "put", "post", "patch", "delete")


class Missing(Exception):
    """Something has no description in the code."""


def wrapped(text: str, first: str = "", rest: str = "") -> str:
    """One paragraph of Markdown, at most :data:`WIDTH` characters wide where its words allow it."""
    return textwrap.fill(
        " ".join(text.split()),
        WIDTH,
        initial_indent=first,
        subsequent_indent=rest,
        break_long_words=False,
        break_on_hyphens=False,
    )


def literal(text: str) -> str:
    """Plain text as Markdown."""
    return re.sub(r"([\\*<\[\]]|\b_|_\b)", r"\\\1", text)


def item(name: str, text: str) -> str:
    """An entry of a list."""
    return wrapped(f"`{name}`: {text}", "- ", "  ")


# --- Command lines ------------------------------------------------------------------------------------------------


def programs() -> Iterator[tuple[str, click.Command]]:
    """Each program's name and command."""
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg", "utf-8")
    for line in setup["options.entry_points"]["console_scripts"].split("\n"):
        if line:
            name, _, target = (part.strip() for part in line.partition("="))
            yield name, _command(target)
    for app in APPS:
        yield f"python -m robot_client.apps.{app}", _command(f"robot_client.apps.{app}:main")


def _command(target: str) -> click.Command:
    module, _, name = target.partition(":")
    found = getattr(import_module(module), name)
    assert isinstance(found, click.Command), target
    return found


def commands(name: str, command: click.Command, parent: click.Context | None) -> Iterator[str]:
    """The text about a command and all below it."""
    context = click.Context(command, info_name=name, parent=parent)
    yield _about_command(command, context)
    if isinstance(command, click.Group):
        for each in command.list_commands(context):
            inner = command.get_command(context, each)
            if inner is not None and not inner.hidden:
                yield from commands(each, inner, context)


def _about_command(command: click.Command, context: click.Context) -> str:
    depth = "##" if context.parent is None else "###"
    if not command.help:
        raise Missing(f"the command {context.command_path} has no help")
    usage = " ".join([context.command_path, *command.collect_usage_pieces(context)])
    blocks = [f"{depth} {context.command_path}", f"```text\n{usage}\n```"]
    blocks += [_paragraph(each) for each in command.help.split("\n\n")]
    options = [
        record
        for each in command.get_params(context)
        if isinstance(each, click.Option)
        and "--help" not in each.opts
        and (record := each.get_help_record(context)) is not None
    ]
    for name, text in options:
        if not text:
            raise Missing(f"{context.command_path}: {name} has no help")
    blocks += ["\n".join(item(name, _option_text(text)) for name, text in options)] if options else []
    epilog = [each for each in (command.epilog or "").split("\n\n") if each.strip()]
    # They are the same for all commands of a program.
    blocks += [_paragraph(each) for each in epilog if depth == "##" or not each.startswith("Exit codes")]
    return "\n\n".join(blocks)


def _option_text(text: str) -> str:
    """The help of an option, with click's remarks about its default and range in round brackets."""
    text, remark = re.fullmatch(
        r"(.*?)\s*(?:\[((?:env var|default|required|x|\d).*)\])?", text, re.DOTALL
    ).groups()  # type: ignore[union-attr]
    return literal(f"{text} ({remark.replace('<=', ' ≤ ')})" if remark else text).strip()


def _paragraph(text: str) -> str:
    r"""A paragraph of a help text. ``\b`` at its start says that its lines stay, here as a block of text."""
    if text.lstrip("\n").startswith("\b"):
        return f"```text\n{textwrap.dedent(text.lstrip().lstrip(chr(8)).strip(chr(10)))}\n```"
    return wrapped(literal(text))


def cli() -> str:
    intro = wrapped(
        "Each program and command, as `--help` shows it; `-h` is short for that. Administration prints tables for"
        " people and `--json` for programs. Passwords come by prompt or `--password-stdin`, never as an argument."
    )
    return "\n\n".join([intro, *("\n\n".join(commands(*each, None)) for each in programs())])


# --- Settings of the robot ----------------------------------------------------------------------------------------


def settings() -> str:
    """All settings of the robot, by the tables of its file."""
    intro = wrapped(
        "The robot reads its settings from the TOML file of `switchboard-robot run --config FILE`. A variable"
        f" such as `{config.ENVIRONMENT}SAFETY_DEADLINE_MS=800` overrides a setting of a plain table."
        " `[cameras]` and tables in double brackets are possible in the file alone."
        " [Examples](../operate/robot_settings.md) are easier to begin with."
    )
    return "\n\n".join([intro, *_tables(config.RobotSettings, "", "")])


def _tables(struct: type[Any], path: str, brackets: str) -> Iterator[str]:
    """A struct's own settings, then its inner tables."""
    told = _parameters(struct)
    plain, inner = [], []
    for field in msgspec.structs.fields(struct):
        table = _struct_in(field.type)
        if table is None:
            if field.name not in told:
                raise Missing(f"{struct.__name__}.{field.name} has no :param:")
            plain.append(item(field.name, f"{_rst(told[field.name])} {_value(field)}"))
        else:
            name = f"{path}.{field.name}".lstrip(".")
            inner.append((table[0], name, f"[[{name}]]" if table[1] else f"[{name}]"))
    if path:
        about = (struct.__doc__ or "").split(":param")[0]
        yield "\n\n".join([f"## `{brackets}`", wrapped(_rst(about)), "\n".join(plain)])
    elif plain:
        yield from ("## `[cameras]`\n\n" + each for each in plain)
    for each in inner:
        yield from _tables(*each)


def _struct_in(kind: Any) -> tuple[type[Any], bool] | None:
    """The struct that a table holds, and whether there may be many of them."""
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return kind, False
    inner = getattr(kind, "__args__", ())
    if getattr(kind, "__origin__", None) is list and (found := _struct_in(inner[0])):
        return found[0], True
    return None


def _parameters(struct: type[Any]) -> dict[str, str]:
    """The ``:param:`` of a struct and of those it extends."""
    found: dict[str, str] = {}
    for each in struct.__mro__[::-1]:
        parts = re.split(r":param (\w+):", each.__doc__ or "")
        found |= dict(zip(parts[1::2], parts[2::2], strict=True))
    return found


def _rst(text: str) -> str:
    """Text of a docstring as Markdown."""
    text = re.sub(r":\w+:`~?([^`]+)`", r"``\1``", text)
    parts = text.strip().split("``")
    return (
        "".join(f"`{part}`" if at % 2 else literal(part) for at, part in enumerate(parts)).rstrip(".") + "."
    )


def _value(field: msgspec.structs.FieldInfo) -> str:
    """Range, choices and default of a setting."""
    said = _range(msgspec.inspect.type_info(field.type))
    made = field.default_factory
    default = field.default if made is msgspec.NODEFAULT else made()
    if default is msgspec.NODEFAULT:
        return f"{said}Required."
    if default is None:
        return f"{said}Default: none."
    return f"{said}Default: `{_toml(default)}`."


def _toml(value: Any) -> str:
    return msgspec.json.encode(value).decode().replace('","', '", "')


def _range(kind: Any) -> str:
    if isinstance(kind, msgspec.inspect.UnionType):
        return "".join(map(_range, kind.types))
    if isinstance(kind, msgspec.inspect.LiteralType):
        return f"One of {', '.join(f'`{each}`' for each in kind.values)}. "
    if not isinstance(kind, msgspec.inspect.IntType | msgspec.inspect.FloatType):
        return ""
    bounds = {"more than": kind.gt, "at least": kind.ge, "less than": kind.lt, "at most": kind.le}
    said = [f"{words} {bound:.10g}" for words, bound in bounds.items() if bound is not None]
    return f"{', '.join(said).capitalize()}. " if said else ""


# --- Limits, metrics, HTTP ----------------------------------------------------------------------------------------


def limit_list() -> str:
    """Constants of ``relay_protocol.limits``. One description may follow several names."""
    lines, names = [], []
    for node in ast.parse(Path(limits.__file__).read_text("utf-8")).body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            name = node.targets[0].id
            if name not in ("KIB", "MIB"):
                names.append(f"`{name}` = {_size(node.value)}")
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and names:
            lines.append(wrapped(f"{', '.join(names)}: {_rst(node.value.value)}", "- ", "  "))
            names = []
    if names:
        raise Missing(f"relay_protocol.limits: {names} have no description")
    intro = wrapped(
        "Relay, robots and clients agree on these limits. Sizes are in bytes and times in seconds, unless the text"
        " says otherwise. [The SPEC](../../protocol/spec/limits.md) says what happens beyond them."
    )
    return f"{intro}\n\n" + "\n".join(lines)


def _size(value: ast.expr) -> str:
    text = ast.unparse(value)
    if found := re.fullmatch(r"(\d+) \* (KIB|MIB)", text):
        return f"{found[1]} {found[2].replace('IB', 'iB')}"
    return str(eval(text, vars(limits)))  # noqa: S307  (an expression of our own file)


def metrics() -> str:
    """Every metric of the relay: calls and rows of tables that begin with its name and its description."""
    found = {}
    for path in sorted((ROOT / "relay_server").rglob("*.py")):
        text = path.read_text("utf-8")
        for node in ast.walk(ast.parse(text)) if "MetricFamily" in text else ():
            if isinstance(node, ast.Call | ast.Tuple) and (metric := _metric(node)):
                found[metric[0]] = metric[1]
    intro = wrapped(
        "The relay shows these at `/metrics`, in the text format of Prometheus, to administrators of the realm"
        f" `{DEFAULT_REALM}`. Those of a cluster are there when the relay has a `--cluster-bus`."
    )
    return f"{intro}\n\n" + "\n".join(item(*each) for each in sorted(found.items()))


def _metric(node: ast.Call | ast.Tuple) -> tuple[str, str] | None:
    """Name and description of a metric, if a call or a row of a table is about one."""
    values = node.args if isinstance(node, ast.Call) else node.elts
    family = getattr(node.func, "id", "") if isinstance(node, ast.Call) else ""
    if family.endswith("MetricFamily") and isinstance(values[0], ast.JoinedStr):
        raise Missing(f"the name of the metric {ast.unparse(values[0])} must be a plain string")
    words = [each.value for each in values[:2] if isinstance(each, ast.Constant)]
    if len(words) < 2 or not str(words[0]).startswith("switchboard_"):
        return None
    kind = "counter" if family.startswith("Counter") else "gauge"
    keywords = node.keywords if isinstance(node, ast.Call) else []
    labels = [ast.literal_eval(each.value) for each in keywords if each.arg == "labels"]
    by = f" Labels: {', '.join(f'`{each}`' for each in labels[0])}." if labels else ""
    return f"{words[0]}{'_total' * (kind == 'counter')}", f"{kind}. {literal(str(words[1]))}.{by}"


def http_api() -> str:
    """Operations of the HTTP API by tag."""
    api = document(operations(), relay_server.VERSION, "switchboard_session")
    blocks = [
        wrapped(
            "A running relay describes its HTTP API in full: OpenAPI 3.1 at `/api/openapi.json`, readable at"
            " `/api/docs`. These are its operations. [Robots over HTTP](../guides/http.md) shows them at work."
        )
    ]
    for tag in api["tags"]:
        lines = [
            item(f"{method.upper()} {path}", literal(operation["summary"]) + ".")
            for path, methods in api["paths"].items()
            for method, operation in methods.items()
            if method in METHODS and tag["name"] in operation["tags"]
        ]
        blocks += [f"## {literal(tag['description'])}", "\n".join(lines)]
    return "\n\n".join(blocks)


PAGES: dict[str, tuple[str, Callable[[], str]]] = {
    "cli.md": ("Command line", cli),
    "settings.md": ("Settings of the robot", settings),
    "limits.md": ("Limits", limit_list),
    "metrics.md": ("Metrics", metrics),
    "http_api.md": ("HTTP API", http_api),
}


def page(name: str) -> str:
    """The text of a page.

    :raises Missing: something has no description in the code
    """
    title, write = PAGES[name]
    return f"# {title}\n\n{NOTE}\n\n{write()}\n"


def main(arguments: list[str]) -> int:
    """Write the pages, or with ``--check`` compare them. Returns the exit code."""
    stale = []
    for name in PAGES:
        path, text = FOLDER / name, page(name)
        if not path.exists() or path.read_text("utf-8") != text:
            stale.append(name)
            if "--check" not in arguments:
                path.write_text(text, "utf-8")
    if "--check" in arguments and stale:
        sys.stderr.write(f"docs/reference: {', '.join(stale)} differ from the code; run 'make reference'\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
