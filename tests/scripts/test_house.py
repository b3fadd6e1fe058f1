"""The counts of ``make house``, on small packages made for it."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture
def house(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script, with an empty package."""
    spec = importlib.util.spec_from_file_location("house", Path("scripts/house.py").resolve())
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(__import__("sys").modules, "house", module)
    spec.loader.exec_module(module)
    for package in ("relay_server", "robot_client"):
        (tmp_path / package).mkdir()
    (tmp_path / "relay_server/relay.py").write_text("")
    monkeypatch.setattr(module, "ROOT", tmp_path)
    packages = {name: tmp_path / name for name in ("relay_server", "robot_client")}
    monkeypatch.setattr(module, "PACKAGES", packages)
    return module


def write(house: ModuleType, name: str, text: str) -> None:
    """Writes a module of the packages."""
    (house.ROOT / name).write_text(text)


def test_imports_for_type_checking_make_a_circle(house: ModuleType) -> None:
    write(house, "relay_server/a.py", "from relay_server.b import B\n")
    write(house, "relay_server/b.py", "if TYPE_CHECKING:\n    from relay_server import a\n\nclass B: ...\n")
    write(house, "relay_server/c.py", "from relay_server.a import A\n")
    assert house.import_circles(house.modules()) == ["2 files: relay_server.a, relay_server.b"]


def test_a_module_imported_within_a_function_counts(house: ModuleType) -> None:
    write(house, "relay_server/a.py", "def f():\n    import relay_server.b\n")
    write(house, "relay_server/b.py", "import relay_server.a\n")
    assert len(house.import_circles(house.modules())) == 1


def test_class_names_are_compared_over_packages(house: ModuleType) -> None:
    write(house, "relay_server/a.py", "class Clock: ...\nclass Other: ...\n")
    write(house, "robot_client/a.py", "class Clock: ...\n")
    assert house.repeated_names(house.modules()) == ["Clock: relay_server.a, robot_client.a"]


def test_private_names_are_found_by_their_last_word(house: ModuleType) -> None:
    write(house, "relay_server/a.py", "class RealmDesk: ...\nclass DeskLamp: ...\nclass _Wish: ...\n")
    found = house.private_names(house.modules())
    assert found == ["relay_server.a.RealmDesk", "relay_server.a._Wish"]


def test_names_and_words_without_a_meaning_are_found(house: ModuleType) -> None:
    """Names by themselves, words in docstrings and comments only."""
    write(
        house,
        "relay_server/a.py",
        '"""Told anew."""\n\ndesk = helpdesk = "told"\n\n\ndef f(_helm): ...  # nobody\n',
    )
    found = house.names_without_meaning(house.modules())
    assert found == ["relay_server/a.py:3 desk", "relay_server/a.py:6 _helm"]
    assert house.unclear_words(house.modules()) == [
        "relay_server/a.py:1 Told",
        "relay_server/a.py:1 anew",
        "relay_server/a.py:6 nobody",
    ]


def test_circles_of_the_portal_are_found(house: ModuleType) -> None:
    """Types count, files of components, and both forms of addresses."""
    (house.ROOT / "web_client/src/lib").mkdir(parents=True)
    write(house, "web_client/src/lib/a.ts", "import type { B } from '$lib/b';\nimport x from 'svelte';\n")
    write(house, "web_client/src/lib/b.ts", 'import C from "../C.svelte";\n')
    write(house, "web_client/src/C.svelte", "<script>import { a } from './lib/a';</script>")
    graph = house.portal_imports()
    assert graph == {"lib/a.ts": {"lib/b.ts"}, "lib/b.ts": {"C.svelte"}, "C.svelte": {"lib/a.ts"}}
    assert house._circle_lines(graph) == ["3 files: C.svelte, lib/a.ts, lib/b.ts"]


def test_constructors_with_an_unpacked_tuple_are_found(house: ModuleType) -> None:
    write(house, "relay_server/a.py", "x = Service(*parts)\ny = function(*parts)\nz = Service(a, b=1)\n")
    assert house.unpacked_calls(house.modules()) == ["relay_server/a.py:1 Service"]


def test_a_count_over_its_limit_fails_and_is_listed(
    house: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write(house, "relay_server/a.py", "class Desk:\n    def f(self): ...\n")
    monkeypatch.setitem(house.LIMITS, "private names", 1)
    assert house.main([]) == 0
    monkeypatch.setitem(house.LIMITS, "private names", 0)
    assert house.main([]) == 1
    assert "relay_server.a.Desk" in capsys.readouterr().out


def test_prose_is_counted(house: ModuleType) -> None:
    long = " ".join(["word"] * 31)
    pages = {
        "README.md": f"# What it is\n\n{long.capitalize()}. What it does is a test.\n\n- Who is there?\n",
        "docs/page.md": f"```sh\nWhat is code.\n{'x' * 101}\n```\n\n| A | {long} |\n\n{'y' * 101}\n",
        "docs/written.md": f"# T\n\n{house.GENERATED}x.py -->\n\nWhoever reads this. {'z' * 101}\n",
    }
    (house.ROOT / "docs").mkdir()
    for name, text in pages.items():
        write(house, name, text)
    counts, details = house.prose()
    assert counts["lines of README.md"] == 5
    assert counts["sentences over 30 words, per cent"] == 50
    assert details["sentences that begin with Who or What"] == ["README.md: What it does is a test."]
    assert details["lines of documents over 100 characters"] == [
        "README.md:3 (179)",
        "docs/page.md:3 (101)",
        "docs/page.md:8 (101)",
    ]
    assert counts["characters of the widest row of a table"] == len(f"| A | {long} |")
