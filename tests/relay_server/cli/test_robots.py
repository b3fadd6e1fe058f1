"""``switchboard robot``."""

from __future__ import annotations

import shlex
import socket
import time
from typing import Any

import pytest

from relay_db import queries
from relay_db.engine import Database
from relay_protocol import identity
from relay_protocol.errors import Refused
from relay_server.auth.passwords import code_hash
from relay_server.recordings.library import FOLDER, RecordingEntry, RecordingState, text_of


def _enrol(cli: Any, robot: str, code: str, agent: str = "robot 1") -> str:
    """Enrols a new key as the relay does; returns its fingerprint."""
    key = identity.public_half(identity.generate_key())
    name = identity.fingerprint(key)
    database = Database(f"sqlite:///{cli.data}/switchboard.db")
    try:
        with database.begin() as s:
            queries.redeem_enrolment_code(s, robot, code_hash(code), key, name, agent, time.time())
    finally:
        database.close()
    return name


def test_a_robot_is_added_with_a_code_that_enrols_it(cli: Any) -> None:
    """The code works once, in any spelling."""
    answer = cli.json("robot", "add", "rover", "--description", "Lab 3")
    assert {**answer, "enrolment_code": ""} == {"robot": "rover", "enrolment_code": "", "expires_in": 900}
    _enrol(cli, "rover", answer["enrolment_code"].lower().replace("-", " "))
    with pytest.raises(Refused):
        _enrol(cli, "rover", answer["enrolment_code"])


def test_the_exact_command_is_printed(cli: Any) -> None:
    """One line to copy, with this machine's name and the usual port."""
    lines = cli.ok("robot", "add", "rover").splitlines()
    command = shlex.split(lines[-1])
    code = lines[1].split()[2]
    assert command[:2] == ["switchboard-robot", "enroll"]
    options = dict(zip(command[2::2], command[3::2], strict=True))
    assert options == {
        "--relay": f"{socket.gethostname()}:9091",
        "--robot": "rover",
        "--code": "-",
        "--state": "/var/lib/switchboard-robot/state",
    }
    _enrol(cli, "rover", code)


def test_the_command_names_the_port_of_the_running_relay(live: Any, relay: Any) -> None:
    """A running relay reports the robots' host and port, and whether it uses TLS."""
    relay.answer = (200, b'{"robots_port": 12345}')
    assert f" --relay {socket.gethostname()}:12345 " in live.ok("robot", "add", "rover")
    relay.answer = (200, b'{"robots_port": 12345, "robots_host": "127.0.0.1", "robots_tls": true}')
    assert " --relay 127.0.0.1:12345 --tls " in live.ok("robot", "add", "rover2")
    relay.answer = (200, b'{"robots_port": 12345, "robots_host": "2001:db8::7", "robots_tls": true}')
    assert " --relay '[2001:db8::7]:12345' --tls " in live.ok("robot", "add", "rover3")


def test_a_new_code_voids_the_one_before(cli: Any) -> None:
    first = cli.json("robot", "add", "rover")["enrolment_code"]
    second = cli.json("robot", "code", "rover")["enrolment_code"]
    with pytest.raises(Refused):
        _enrol(cli, "rover", first)
    _enrol(cli, "rover", second)


@pytest.mark.parametrize("name", ["Rover", "a b", "a\x1b[2J", "-", "a/b", "x" * 64])
def test_a_robot_name_that_cannot_be_is_refused(cli: Any, name: str) -> None:
    """The error describes valid names."""
    reported = cli.fails("robot", "add", "--", name)
    assert reported.startswith("Error: a robot's name has lower-case letters")


def test_robots_are_listed_with_their_live_keys(cli: Any) -> None:
    """Invalid descriptions are refused, and markup in them is printed as text."""
    cli.ok("robot", "add", "rover", "--description", "[red]x[/red] :boom:")
    code = cli.json("robot", "add", "arm")["enrolment_code"]
    _enrol(cli, "arm", code)
    assert cli.json("robot", "list") == [
        {"robot": "arm", "description": "", "keys": 1, "shared": []},
        {"robot": "rover", "description": "[red]x[/red] :boom:", "keys": 0, "shared": []},
    ]
    table = cli.ok("robot", "list")
    assert "[red]x[/red] :boom:" in table
    assert "not enrolled" in table
    assert "printable" in cli.fails("robot", "add", "b", "--description", "\x1b[2J")


def test_keys_are_listed_and_revoked(cli: Any) -> None:
    """A revoked key stays in the list as retired; the robot's own description cannot control the terminal."""
    code = cli.json("robot", "add", "rover")["enrolment_code"]
    name = _enrol(cli, "rover", code, agent="\x1b]0;pwned\x07 [bold]1")
    table = cli.ok("robot", "keys", "rover")
    assert name in table
    assert "live" in table
    assert "\x1b" not in table
    assert "\\x1b]0;pwned\\x07 [bold]1" in table
    [key] = cli.json("robot", "keys", "rover", "--revoke", name)
    assert key["fingerprint"] == name
    assert key["retired"] is not None
    assert "retired" in cli.ok("robot", "keys", "rover")
    assert "no such live key" in cli.fails("robot", "keys", "rover", "--revoke", name)


def test_a_robot_is_removed(cli: Any) -> None:
    """The command asks for confirmation."""
    cli.ok("robot", "add", "rover")
    assert cli("robot", "remove", "rover", stdin="n\n").exit_code == 1
    assert cli.json("robot", "remove", "rover", "--yes") == {"robot": "rover", "removed": True}
    assert cli.json("robot", "list") == []
    for command in ("remove", "code", "keys"):
        assert "no robot 'rover'" in cli.fails("robot", command, "rover")


def test_recordings_are_named_before_a_robot_is_removed(cli: Any) -> None:
    """The question says how many and how large they are; the relay deletes them."""
    cli.ok("robot", "add", "rover")
    folder = cli.data / FOLDER
    folder.mkdir()
    for id, size in (("a", 1_200_000), ("b", 50_000)):
        entry = RecordingEntry(
            id, 1, "rover", 1, "ann", ("/odom",), (), 1.0, 10**7, 60.0, state=RecordingState.COMPLETE
        )
        (folder / f"{id}.json").write_bytes(text_of(entry))
        (folder / f"{id}.mcap").write_bytes(bytes(size))
    asked = cli("robot", "remove", "rover", stdin="n\n")
    assert "its keys and all rights on it, and its 2 recordings (1.3 MB)?" in asked.stderr
    reported = cli.ok("robot", "remove", "rover", "--yes")
    assert (
        "The relay deletes its 2 recordings (1.3 MB): now if it runs, otherwise when it starts." in reported
    )
    *_, entry = cli.json("audit", "list")
    assert entry["data"] == {"recordings": 2}
