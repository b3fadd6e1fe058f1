"""Definition texts of types, with all types they contain."""

from __future__ import annotations

from pathlib import Path

import pytest

from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound
from relay_protocol.limits import INTERFACES, JSON_BODY
from robot_client.platforms.definitions import (
    RULE,
    all_names,
    contained,
    full_text,
    installed,
    normalise,
    prefixes,
    type_hash,
)

TEXTS = {
    "a/msg/Outer": "# made of others\nInner one\nb/Far[] many\nHeader header\nfloat64[9] k\nstring<=5 s\nint8 C=3\n",
    "a/msg/Inner": "Deep deep\nbool[<=3] flags\n",
    "a/msg/Deep": "uint8 X=1  # Inner not here\nuint8 x\n",
    "b/msg/Far": "a/Deep near\n",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec\n",
    "a/srv/Do": "Inner what\n---\nbool ok\nb/Far far\n",
}


def test_contained_types_follow_once_after_a_rule() -> None:
    """At any depth."""
    parts = full_text("a/msg/Outer", TEXTS.get).split(RULE + "\n")
    assert parts[0] == TEXTS["a/msg/Outer"]
    assert [part.split("\n")[0] for part in parts[1:]] == [
        "MSG: a/Inner",
        "MSG: b/Far",
        "MSG: std_msgs/Header",
        "MSG: a/Deep",
        "MSG: builtin_interfaces/Time",
    ]


def test_service_has_both_halves() -> None:
    text = full_text("a/srv/Do", TEXTS.get)
    assert text.startswith("Inner what\n---\nbool ok\n")
    assert "MSG: a/Inner" in text
    assert "MSG: b/Far" in text


def test_comments_and_constants_contain_no_types() -> None:
    assert contained(TEXTS["a/msg/Deep"], "a", TEXTS.get) == []


def test_missing_contained_type_is_named() -> None:
    with pytest.raises(NotFound, match="b/msg/Far"):
        full_text("a/msg/Outer", {key: text for key, text in TEXTS.items() if key != "b/msg/Far"}.get)


def test_too_large_definition_is_refused() -> None:
    with pytest.raises(Invalid, match="larger"):
        full_text("a/msg/Big", lambda name: "# " + "x" * 300_000)


@pytest.mark.parametrize(
    ("name", "full"),
    [("std_msgs/String", "std_msgs/msg/String"), ("a/srv/B", "a/srv/B"), ("a/msg/B", "a/msg/B")],
)
def test_short_names_are_completed(name: str, full: str) -> None:
    assert normalise(name) == full


@pytest.mark.parametrize(
    "name", ["", "String", "../../etc/passwd", "a/msg/../x", "a/msg/b/c", "a/lib/B", "a/msg/B\n"]
)
def test_paths_are_refused_as_type_names(name: str) -> None:
    with pytest.raises(Invalid):
        normalise(name)


def test_files_and_hashes_are_found_under_share(tmp_path: Path) -> None:
    """In the first prefix that has them."""
    folder = tmp_path / "share" / "a" / "msg"
    folder.mkdir(parents=True)
    (folder / "B.msg").write_text("int8 x\n")
    (folder / "B.json").write_text('{"type_hashes":[{"type_name":"a/msg/B","hash_string":"RIHS01_ab"}]}')
    where = [tmp_path / "none", tmp_path]
    assert installed("a/msg/B", where) == "int8 x\n"
    assert type_hash("a/msg/B", where) == "RIHS01_ab"
    assert installed("a/msg/C", where) is None
    assert type_hash("a/msg/C", where) == ""


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r", "\f", "\x85", "\u2028"])
def test_lines_end_with_a_line_feed(tmp_path: Path, end: str) -> None:
    """As in rosidl, other line ends count too."""
    folder = tmp_path / "share" / "a" / "msg"
    folder.mkdir(parents=True)
    (folder / "B.msg").write_bytes(f"int8 x # why{end}# more{end}a/C y".encode())
    assert installed("a/msg/B", [tmp_path]) == "int8 x # why\n# more\na/C y\n"


def test_ament_prefixes_come_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/jazzy:/ws/install")
    assert [str(each) for each in prefixes()[:2]] == ["/opt/ros/jazzy", "/ws/install"]


def test_action_has_its_three_parts() -> None:
    texts = {**TEXTS, "a/action/Go": "Inner to\n---\nb/Far end\n---\nfloat64 left\n"}
    text = full_text("a/action/Go", texts.get)
    assert text.startswith("Inner to\n---\nb/Far end\n---\nfloat64 left\n" + RULE)
    assert "MSG: a/Inner\n" in text
    assert "MSG: b/Far\n" in text


def test_all_names_are_found(tmp_path: Path) -> None:
    """By files and by the resource index, each once."""
    share = tmp_path / "share"
    for name in ("b/msg/Two.msg", "b/msg/Two.idl", "b/msg/README.md", "a/action/Go.action", "c/cmake/x.srv"):
        (share / name).parent.mkdir(parents=True, exist_ok=True)
        (share / name).write_text("")
    index = share / "ament_index" / "resource_index" / "rosidl_interfaces"
    index.mkdir(parents=True)
    (index / "b").write_text("msg/Two.idl\nmsg/Two.msg\nmsg/Idl.idl\nsrv/../../x.srv\n")
    (index / "broken").write_bytes(b"\xff")
    assert all_names([tmp_path, tmp_path / "nowhere"]) == ["a/action/Go", "b/msg/Idl", "b/msg/Two"]


def test_names_fit_into_one_message(tmp_path: Path) -> None:
    index = tmp_path / "share" / "ament_index" / "resource_index" / "rosidl_interfaces"
    index.mkdir(parents=True)
    (index / "long").write_text("\n".join(f"msg/{'X' * 230}{number:05}.msg" for number in range(6000)))
    (index / "short").write_text("\n".join(f"msg/Y{number:05}.msg" for number in range(9000)))
    names = all_names([tmp_path])
    assert 4000 < len(names) < 6000
    assert len(link.frame(link.Interfaces(types=names))) <= JSON_BODY
    (index / "long").unlink()
    assert len(all_names([tmp_path])) == INTERFACES
