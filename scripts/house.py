"""Count what makes code and documents hard to find one's way in, and fail when a count grows. Run by ``make house``.

It reads the product's Python files as syntax trees, and the documents as text; nothing is imported or run.
"""

from __future__ import annotations

import ast
import itertools
import os
import re
import statistics
import sys
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

PACKAGES = {
    "relay_protocol": ROOT / "protocol/relay_protocol",
    "relay_db": ROOT / "db/relay_db",
    "relay_server": ROOT / "relay_server",
    "robot_client": ROOT / "robot_client",
}

LIMITS = {
    "files in import circles": 0,
    "files of the portal in import circles": 0,
    "class names that occur twice": 0,
    "private names": 0,
    "names that are no terms": 0,
    "unclear words in docstrings and comments": 0,
    "calls with an unpacked tuple": 0,
    "lines of relay_server/relay.py": 200,
    "lines of a function, 90th percentile": 30,
    "functions over 60 lines": 1,
    "lines of README.md": 150,
    "sentences over 30 words, per cent": 5,
    "sentences that begin with Who or What": 0,
    "lines of documents over 100 characters": 17,
    "characters of the widest row of a table": 486,
}
"""The most there may be of each. A change may lower them, never raise them."""

# fmt: off
PRIVATE = frozenset({
    "Again", "Answers", "Asker", "Asking", "Bereft", "Bodies", "Book", "Calling", "Comeback", "Concern",
    "Crowd", "Dating", "Desk", "Doorbell", "Ear", "Eye", "Errand", "Errands", "Fence", "Flaw", "FrontDesk",
    "Grip", "Grips", "Guest", "Guests", "Halted", "Heap", "Helm", "Hop", "House", "Incoming", "Invitation",
    "Journal", "Listening", "Look", "Looks", "Made", "Manners", "Meant", "Mender", "Moments",
    "Noticing", "Numbers", "Occupant", "Office", "Offer", "Offers", "Onlooker", "Outbox", "Outlet", "Owed",
    "Parcel", "People", "Picture", "Pinging", "Place", "Presence", "Providing", "Publishing", "Pulse",
    "Pursuer", "Pursuing", "Pursuits", "Pushing", "Said", "Screen", "Senses", "Sent", "Share",
    "Sheet", "Shot", "Steering", "Stilling", "Studio", "Sweep", "Taken", "Taking", "TakingUp", "Tally",
    "Tape", "Tellers", "Telling", "Tenure", "Terms", "Told", "Trip", "Turns", "Voice", "Wanted", "Wanting",
    "Watching", "Ways", "Wish", "Wishes", "Witness", "Workshop",
})
# fmt: on
"""Words that name nothing in ROS, HTTP, OAuth or publish/subscribe; no class name ends in one of them."""

# fmt: off
NO_TERMS = frozenset({
    "told", "asker", "desk", "desks", "moments", "listening", "journal", "hall", "guests", "keeper", "helm", "pursuing",
    "providing", "giving", "meanings", "rooms", "offices", "below", "beside",
})
# fmt: on
"""Names of variables, attributes, parameters and functions that do not say what they hold."""

UNCLEAR = re.compile(r"\b(?:told|tells?|telling|hears?|heard|somebody|nobody|anew)\b", re.IGNORECASE)
"""Words of docstrings and comments that a plainer one replaces: notify, receive, distinguish, again."""

GENERATED = "<!-- Written by scripts/"
"""Pages that begin with this under their heading are written by programs, and not counted."""

_FIGURES = re.compile(r"<!-- figures.*?<!-- end of figures -->", re.DOTALL)
"""The part of a page that ``bench.page`` writes."""

_NOT_PROSE = re.compile(r"^ *```.*?^ *```|<!--.*?-->|^#.*?$|^\*\*[\d.]+-\d+\*\* ", re.DOTALL | re.MULTILINE)
"""Code, comments, headings, and the ids of rules of the specification."""

_LINK = re.compile(r"!?\[([^\]]*)\](?:\([^)]*\)|\[[^\]]*\])")
_BLOCK_END = re.compile(r"\n\s*\n|\n(?=\s*(?:[-*]|\d+\.)\s)|\|")
_SENTENCE_END = re.compile(r"(?<=[.!?])[*_)]*\s+(?=[A-Z`\[(*\"“0-9])")
_BARE_SUBJECT = re.compile(r"[*_]*(?:Who|What)(?:ever)?\b(?!.*\?[*_]*\Z)")

SHARED_NAMES = {"relay_protocol"}
"""Packages whose classes are named after the protocol's own messages, and may share those names."""


@dataclass(frozen=True)
class Module:
    """One file of the product."""

    name: str
    path: Path
    tree: ast.Module


def modules() -> list[Module]:
    """All modules of the product, parsed."""
    found = []
    for package, folder in PACKAGES.items():
        for path in sorted(folder.rglob("*.py")):
            parts = path.relative_to(folder).with_suffix("").parts
            name = ".".join((package, *parts)).removesuffix(".__init__")
            found.append(Module(name, path, ast.parse(path.read_text(), str(path))))
    return found


def imports_of(module: Module, known: set[str]) -> set[str]:
    """Modules of the product that this one imports anywhere, also for type checking alone."""
    package = module.name if module.path.name == "__init__.py" else module.name.rpartition(".")[0]
    found: set[str] = set()
    for node in ast.walk(module.tree):
        if isinstance(node, ast.Import):
            found.update(each.name for each in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = (
                ".".join(package.split(".")[: len(package.split(".")) - node.level + 1]) if node.level else ""
            )
            source = ".".join(filter(None, (base, node.module)))
            for each in node.names:
                inner = f"{source}.{each.name}"
                found.add(inner if inner in known else source)
    return (found & known) - {module.name}


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Groups of modules that reach each other by imports (Tarjan's strongly connected components)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(name: str) -> None:
        index[name] = low[name] = len(index)
        stack.append(name)
        for other in sorted(graph[name]):
            if other not in index:
                visit(other)
                low[name] = min(low[name], low[other])
            elif other in stack:
                low[name] = min(low[name], index[other])
        if low[name] == index[name]:
            group = stack[stack.index(name) :]
            del stack[stack.index(name) :]
            if len(group) > 1:
                found.append(sorted(group))

    for name in graph:
        if name not in index:
            visit(name)
    return found


def import_circles(all_modules: list[Module]) -> list[str]:
    """One line per circle. A package's ``__init__`` that only re-exports its own modules is no part of one."""
    known = {each.name for each in all_modules}
    faces = {each.name for each in all_modules if each.path.name == "__init__.py"}
    graph = {}
    for each in all_modules:
        if each.name not in faces:
            graph[each.name] = imports_of(each, known) - faces
    return _circle_lines(graph)


_PORTAL_IMPORT = re.compile(r"""\b(?:from|import)\s*\(?\s*["']([^"']+)["']""")


def portal_imports() -> dict[str, set[str]]:
    """The portal's files, and which of the others each imports, for types too."""
    root = ROOT / "web_client/src"
    files = [path for kind in ("ts", "svelte") for path in root.rglob(f"*.{kind}")]
    known = {path: str(path.relative_to(root)) for path in files if ".test." not in path.name}
    graph = {}
    for path, name in known.items():
        found = set()
        for given in _PORTAL_IMPORT.findall(path.read_text("utf-8")):
            there = root / "lib" / given[5:] if given.startswith("$lib/") else path.parent / given
            ends = ("", ".ts", "/index.ts")
            found |= {Path(os.path.normpath(f"{there}{end}")) for end in ends} & known.keys()
        graph[name] = {known[each] for each in found} - {name}
    return graph


def _circle_lines(graph: dict[str, set[str]]) -> list[str]:
    return [f"{len(group)} files: {', '.join(group)}" for group in circles(graph)]


def classes(all_modules: list[Module]) -> Iterator[tuple[Module, ast.ClassDef]]:
    """Every class at the top level of a module."""
    for module in all_modules:
        for node in module.tree.body:
            if isinstance(node, ast.ClassDef):
                yield module, node


def repeated_names(all_modules: list[Module]) -> list[str]:
    """Class names that occur in more than one module, with where."""
    places: dict[str, list[str]] = defaultdict(list)
    for module, node in classes(all_modules):
        if module.name.split(".")[0] not in SHARED_NAMES:
            places[node.name].append(module.name)
    return [f"{name}: {', '.join(where)}" for name, where in sorted(places.items()) if len(where) > 1]


def private_names(all_modules: list[Module]) -> list[str]:
    """Classes whose last word is in :data:`PRIVATE`; "Sent" names a message well as the end of a longer name."""
    words = re.compile(r"[A-Z][a-z0-9]*")
    found = []
    for module, node in classes(all_modules):
        last = words.findall(node.name)[-1:]
        if last and (last[0] in PRIVATE - {"Sent"} or node.name.lstrip("_") in PRIVATE):
            found.append(f"{module.name}.{node.name}")
    return found


def _names_of(node: ast.AST) -> list[str]:
    """Names that a node of a syntax tree gives or uses."""
    if isinstance(node, ast.Name):
        return [node.id]
    if isinstance(node, ast.Attribute):
        return [node.attr]
    if isinstance(node, ast.arg | ast.keyword):
        return [node.arg or ""]
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        return [node.name]
    return []


def names_without_meaning(all_modules: list[Module]) -> list[str]:
    """Variables, attributes, parameters and functions that are called one of :data:`NO_TERMS`."""
    return [
        f"{module.path.relative_to(ROOT)}:{getattr(node, 'lineno', 0)} {name}"
        for module in all_modules
        for node in ast.walk(module.tree)
        for name in _names_of(node)
        if name.strip("_") in NO_TERMS
    ]


def _texts(module: Module) -> Iterator[tuple[int, str]]:
    """Docstrings, of variables too, and comments of a module, with their lines."""
    for node in ast.walk(module.tree):
        if (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            yield node.lineno, node.value.value
    with tokenize.open(module.path) as stream:
        for token in tokenize.generate_tokens(stream.readline):
            if token.type == tokenize.COMMENT:
                yield token.start[0], token.string


def unclear_words(all_modules: list[Module]) -> list[str]:
    """Words of :data:`UNCLEAR` in docstrings and comments."""
    return [
        f"{module.path.relative_to(ROOT)}:{line} {word}"
        for module in all_modules
        for line, text in _texts(module)
        for word in UNCLEAR.findall(text)
    ]


def _is_unpacked(argument: ast.expr) -> bool:
    """Whether an argument is an unpacked tuple. ``*args`` hands on what a function was given itself."""
    return isinstance(argument, ast.Starred) and getattr(argument.value, "id", "") != "args"


def unpacked_calls(all_modules: list[Module]) -> list[str]:
    """Constructor calls that unpack a tuple into positional parameters."""
    found = []
    for module in all_modules:
        for node in ast.walk(module.tree):
            if not isinstance(node, ast.Call) or not any(map(_is_unpacked, node.args)):
                continue
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if called[:1].isupper():
                found.append(f"{module.path.relative_to(ROOT)}:{node.lineno} {called}")
    return found


def function_lengths(all_modules: list[Module]) -> list[tuple[int, str]]:
    """Lines of each function, from its ``def`` to its end, and where it stands."""
    found = []
    for module in all_modules:
        for node in ast.walk(module.tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = (node.end_lineno or node.lineno) - node.lineno + 1
                found.append((lines, f"{module.path.relative_to(ROOT)}:{node.lineno} {node.name} ({lines})"))
    return found


def documents() -> Iterator[tuple[Path, str]]:
    """The README, the pages of ``docs`` without generated ones, and the specification of the protocol."""
    pages = [folder.rglob("*.md") for folder in (ROOT / "docs", ROOT / "protocol/spec")]
    for path in [ROOT / "README.md", *sorted(itertools.chain(*pages))]:
        if path.exists() and GENERATED not in (text := path.read_text("utf-8")):
            yield path, _FIGURES.sub(lambda part: "\n" * part[0].count("\n"), text)


def sentences(text: str) -> Iterator[str]:
    """Sentences of a document: of paragraphs, lists and cells of tables. Code counts as one word."""
    text = _LINK.sub(r"\1", re.sub(r"`[^`\n]*`", "`x`", _NOT_PROSE.sub("\n\n", text)))
    for block in _BLOCK_END.split(text):
        words = " ".join(block.split()).lstrip("-* ")
        yield from (each for each in _SENTENCE_END.split(words) if " " in each)


def prose() -> tuple[dict[str, int], dict[str, list[str]]]:
    """Counts of the documents, and where each was found."""
    all_sentences = [(path.relative_to(ROOT), each) for path, text in documents() for each in sentences(text)]
    lines = [
        (path.relative_to(ROOT), number, line)
        for path, text in documents()
        for number, line in enumerate(text.splitlines(), 1)
    ]
    tables = [
        (len(line), f"{path}:{number} ({len(line)})") for path, number, line in lines if "|" in line[:1]
    ]
    details = {
        "sentences over 30 words, per cent": [f"{p}: {s}" for p, s in all_sentences if len(s.split()) > 30],
        "sentences that begin with Who or What": [
            f"{p}: {s}" for p, s in all_sentences if _BARE_SUBJECT.match(s)
        ],
        "lines of documents over 100 characters": [
            f"{path}:{number} ({len(line)})"
            for path, number, line in lines
            if len(line) > 100 and line[0] != "|"
        ],
        "characters of the widest row of a table": [max(tables)[1]] if tables else [],
    }
    counts = {name: len(found) for name, found in details.items()}
    counts["sentences over 30 words, per cent"] = -(
        -100 * counts["sentences over 30 words, per cent"] // max(1, len(all_sentences))
    )
    counts["characters of the widest row of a table"] = max(tables)[0] if tables else 0
    counts["lines of README.md"] = sum(path.name == "README.md" for path, _, _ in lines)
    return counts, details


def say(line: str) -> None:
    """Print one line."""
    sys.stdout.write(f"{line}\n")


def main(arguments: list[str]) -> int:
    """Print the counts, with ``--all`` also what was counted. Returns 1 when one is over its limit."""
    all_modules = modules()
    lengths = sorted(function_lengths(all_modules))
    details = {
        "files in import circles": import_circles(all_modules),
        "files of the portal in import circles": _circle_lines(portal_imports()),
        "class names that occur twice": repeated_names(all_modules),
        "private names": private_names(all_modules),
        "names that are no terms": names_without_meaning(all_modules),
        "unclear words in docstrings and comments": unclear_words(all_modules),
        "calls with an unpacked tuple": unpacked_calls(all_modules),
        "functions over 60 lines": [text for lines, text in lengths if lines > 60],
    }
    counts = {name: len(lines) for name, lines in details.items()}
    for name in ("files in import circles", "files of the portal in import circles"):
        counts[name] = sum(int(line.split()[0]) for line in details[name])
    prose_counts, prose_details = prose()
    counts |= prose_counts
    details |= prose_details
    counts["lines of relay_server/relay.py"] = len((ROOT / "relay_server/relay.py").read_text().splitlines())
    counts["lines of a function, 90th percentile"] = lengths[len(lengths) * 9 // 10][0]
    worse = [name for name, limit in LIMITS.items() if counts[name] > limit]
    for name, limit in LIMITS.items():
        say(f"{counts[name]:>6}  {name} (at most {limit})")
        if "--all" in arguments or name in worse:
            sys.stdout.writelines(f"          {line}\n" for line in details.get(name, []))
    say(f"{statistics.median(lines for lines, _ in lengths):>6g}  lines of a function, median")
    for package, folder in PACKAGES.items():
        files = [each for each in all_modules if each.name.split(".")[0] == package]
        lines = sum(len(each.path.read_text().splitlines()) for each in files)
        say(f"{len(files):>6}  files, {lines} lines in {folder.relative_to(ROOT)}")
    if worse:
        say(f"house: over the limit: {', '.join(worse)}")
    return 1 if worse else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
