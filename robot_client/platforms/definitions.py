"""Definition texts of ROS 2 interfaces with all types they contain, in the layout of rosbag2's ``ros2msg``.

They are read from the ``.msg``, ``.srv`` and ``.action`` files under ``share/``; no ROS is imported here.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Callable, Iterable
from itertools import accumulate
from pathlib import Path

from relay_protocol.errors import Invalid, NotFound
from relay_protocol.limits import INTERFACES, JSON_BODY, KIB, NAME, TYPE_DEFINITION

RULE = "=" * 80
_TYPE_NAME = re.compile(r"([A-Za-z][A-Za-z0-9_]*)/(msg|srv|action)/([A-Za-z][A-Za-z0-9_]*)\Z")
_FIELD = re.compile(r"^\s*([A-Za-z][A-Za-z0-9_/]*)(<=\d+)?(\[[^\]]*\])?\s+[A-Za-z]")
_PRIMITIVES = frozenset(
    [
        "bool",
        "byte",
        "char",
        "float32",
        "float64",
        "int8",
        "uint8",
        "int16",
        "uint16",
        "int32",
        "uint32",
        "int64",
        "uint64",
        "string",
        "wstring",
    ]
)

Lookup = Callable[[str], str | None]


def normalise(name: str, kind: str = "msg") -> str:
    """A type's full name: ``std_msgs/String`` is short for ``std_msgs/msg/String``.

    :param kind: ``msg``, ``srv`` or ``action``, the meaning of a short name
    :raises Invalid: not a type name
    """
    if name.count("/") == 1:
        name = name.replace("/", f"/{kind}/")
    if not _TYPE_NAME.match(name):
        raise Invalid(f"'{name}' is not a type; write package/{kind}/Name")
    return name


def prefixes() -> list[Path]:
    """Prefixes where interfaces may be installed: those in ``AMENT_PREFIX_PATH``, then those of Python's
    packages."""
    found = [Path(each) for each in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if each]
    found.append(Path(sys.prefix))
    for entry in sys.path:
        # <prefix>/lib/python3.x/site-packages
        parents = Path(entry).parents
        if entry.endswith(("site-packages", "dist-packages")) and len(parents) > 2:
            found.append(parents[2])
    return list(dict.fromkeys(found))


def all_names(where: Iterable[Path]) -> list[str]:
    """Full names of all installed types, sorted, as many as fit into a message.

    ament's resource index also has types without definition files; a package that is not in the index is
    found by its files.
    """
    found: set[str] = set()
    for prefix in where:
        for listing in prefix.glob("share/ament_index/resource_index/rosidl_interfaces/*"):
            found.update(f"{listing.name}/{each}" for each in _read_lines(listing))
        for kind in ("msg", "srv", "action"):
            paths = prefix.glob(f"share/*/{kind}/*.{kind}")
            found.update(f"{each.parent.parent.name}/{kind}/{each.name}" for each in paths)
    names = {name.rpartition(".")[0] for name in found if name.endswith((".msg", ".srv", ".action", ".idl"))}
    known = sorted(name for name in names if len(name) <= NAME and _TYPE_NAME.match(name))
    room = JSON_BODY - KIB
    # Each needs its length, quotes and a comma; a longer message would close the link.
    sizes = accumulate(len(name) + 3 for name in known)
    return [name for name, size in zip(known, sizes, strict=True) if size <= room][:INTERFACES]


def _read_lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").split()
    except (OSError, UnicodeDecodeError):
        return []


def installed(name: str, where: Iterable[Path], suffix: str = "") -> str | None:
    """Content of a type's file; ``None`` if there is none.

    :param name: full type name
    :param suffix: ``.json`` for the description with the hashes, empty for the definition
    """
    package, kind, short = name.split("/")
    for prefix in where:
        path = prefix / "share" / package / kind / (short + (suffix or "." + kind))
        try:
            # As in rosidl, a form feed ends a line too. In the texts that are sent only a line feed does.
            return "".join(f"{line}\n" for line in path.read_text(encoding="utf-8").splitlines())
        except (OSError, UnicodeDecodeError):
            continue
    return None


def type_hash(name: str, where: Iterable[Path]) -> str:
    """The RIHS01 hash that the distribution installed beside the type; empty if there is none."""
    text = installed(name, where, ".json")
    if text is None:
        return ""
    try:
        hashes = {each["type_name"]: each["hash_string"] for each in json.loads(text)["type_hashes"]}
    except (ValueError, KeyError, TypeError):
        return ""
    return str(hashes.get(name, ""))


def full_text(name: str, lookup: Lookup) -> str:
    """A type's text, followed by each type it contains after a rule and ``MSG: package/Name``.

    :param lookup: returns the text of one type by its full name
    :raises NotFound: the type, or one it contains, is not installed
    :raises Invalid: the whole text is too large to send
    """
    main = lookup(name)
    if main is None:
        raise NotFound(f"the type {name} is not installed on this robot")
    parts = [main.rstrip("\n") + "\n"]
    known = {name}
    pending = contained(main, name.split("/")[0], lookup)
    while pending:
        each = pending.pop(0)
        if each in known:
            continue
        known.add(each)
        text = lookup(each)
        if text is None:
            raise NotFound(f"{name} contains {each}, which is not installed on this robot")
        package, _, short = each.split("/")
        parts.append(f"{RULE}\nMSG: {package}/{short}\n{text.rstrip(chr(10))}\n")
        pending += contained(text, package, lookup)
    whole = "".join(parts)
    if len(whole.encode()) > TYPE_DEFINITION:
        raise Invalid(f"the definition of {name} is larger than {TYPE_DEFINITION} bytes")
    return whole


def contained(text: str, package: str, lookup: Lookup) -> list[str]:
    """Full names of the messages that are types of fields, in order.

    :param package: of the text
    :param lookup: as in :func:`full_text`
    """
    found: dict[str, None] = {}
    for line in text.splitlines():
        match = _FIELD.match(line.split("#", 1)[0])
        if match is None or match[1] in _PRIMITIVES:
            continue
        found[_full(match[1], package, lookup)] = None
    return list(found)


def _full(name: str, package: str, lookup: Lookup) -> str:
    parts = name.split("/")
    if len(parts) > 1:
        return f"{parts[0]}/msg/{parts[-1]}"
    own = f"{package}/msg/{name}"
    # As in rosidl, a name without package is of the same package. ROS 1 had one exception, which is still in use.
    return "std_msgs/msg/Header" if name == "Header" and lookup(own) is None else own
