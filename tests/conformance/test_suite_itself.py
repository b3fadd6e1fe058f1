"""The suite's own machinery: results of cases, the table, the exit status."""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from conformance_suite import FIXTURE_VERSION
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
CASES = '''
import pytest
from conformance_suite import case, not_offered, not_tried

@case("good", "section 1")
def test_good():
    """It works."""

@case("known", "section 2", suite="it is known (some_file.py)")
def test_known():
    """It is known to differ."""
    assert 1 == 2

@case("known", "section 2", suite="it is known (some_file.py)")
def test_known_but_good():
    """It was known to differ."""

@case("missing", "section 3")
def test_missing():
    """It can't be tried."""
    not_tried("no TOKEN was given")

@case("missing", "section 3")
def test_not_offered():
    """It is not there."""
    not_offered("no wheels")
'''
BAD = '''
@case("bad", "section 4")
@pytest.mark.parametrize("what", ["[red]"])
def test_bad(what):
    """It fails."""
    assert "this" == "that"
'''


SPEC_CASES = '''
import pytest
from conformance_suite import case

@case("ours", "SPEC 1.2 ours")
def test_ours():
    """Only ours does that."""
    assert 1 == 2

@case("ours", "SPEC 1.2 ours; rosbridge v2, 3.1")
def test_ours_met():
    """Theirs does it too."""

@pytest.fixture
def broken():
    raise AssertionError("it has no such thing")

@case("ours", "SPEC 1.2 ours")
def test_ours_in_a_fixture(broken):
    """Its fixture asks for it."""

@pytest.fixture
def untidy():
    yield
    raise AssertionError("it can't be cleared away")

@case("ours", "SPEC 1.2 ours")
def test_ours_with_remains(untidy):
    """It leaves something behind."""
    assert 1 == 2
'''
HANGS = '''
from conformance_suite import case

@case("good", "section 1")
def test_first(client):
    """It lives."""
    client.lives()

@case("bad", "section 2")
def test_hang(client):
    """It hangs."""
    client.send("hang")
    client.lives()

@case("good", "section 3")
def test_later(client):
    """It lives again."""
    client.lives()

@case("good", "section 4")
def test_last(client):
    """It still lives."""
    client.lives()
'''


class FakeServer:
    """A rosbridge server with the fixture node, as far as the suite needs one. It hangs on request.

    :param again: a file; while it exists the server does not hang
    """

    def __init__(self, again: Path) -> None:
        self._again = again
        self._hangs = False
        self.has_rosapi = True
        self.answered = 0
        self._server = serve(self._client, "127.0.0.1", 0)
        self.url = f"ws://127.0.0.1:{self._server.socket.getsockname()[1]}"
        self._thread = threading.Thread(target=self._server.serve_forever)
        self._thread.start()

    def __enter__(self) -> FakeServer:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._thread.join()

    def _client(self, connection: ServerConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            for text in connection:
                answer = self._answer(json.loads(text))
                if answer is not None and not (self._hangs and not self._again.exists()):
                    self.answered += 1
                    connection.send(json.dumps({"topic": "/conformance/about", **answer}))

    def _answer(self, said: dict[str, Any]) -> dict[str, Any] | None:
        if said["op"] == "hang":
            self._hangs = True
            return None
        if said["op"] == "subscribe":
            about = json.dumps({"version": FIXTURE_VERSION, "example_interfaces": False})
            return {"op": "publish", "msg": {"data": about}}
        if said["op"] == "kill rosapi":
            self.has_rosapi = False
            return None
        if said["service"].startswith("/rosapi/") and not (self.has_rosapi or self._again.exists()):
            return None
        values = {"success": True, "message": "inverted"}
        if said["service"] == "/conformance/do":
            values = {"result": {"names": []}}
        return {"op": "service_response", "id": said["id"], "result": True, "values": values}


def run(folder: Path, cases: str, *options: str) -> subprocess.CompletedProcess[str]:
    """Runs cases as ``make conformance`` does."""
    file = folder / "test_cases.py"
    file.write_text(cases)
    paths = [str(HERE), str(ROOT), str(ROOT / "protocol")]
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-p",
        "conftest",
        "-c",
        os.devnull,
    ]
    command += ["--rootdir", str(folder), "--table", *options, str(file)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    return subprocess.run(
        command, capture_output=True, text=True, timeout=60, check=False, cwd=folder, env=environment
    )


def test_known_differences_of_the_target_are_no_failures(tmp_path: Path) -> None:
    """With the target named, a marked case that fails differs as known, with the reason, and the status is 0."""
    done = run(tmp_path, CASES, "--target", "rosbridge_suite")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 passed, 1 differs, 1 not tried, 1 not offered" in done.stdout
    for text in ("differs as known", "it is known (some_file.py)", "no TOKEN was given", "no wheels"):
        assert text in done.stdout


def test_without_the_target_they_are(tmp_path: Path) -> None:
    """Without the target named, the same case is a failure, and the status is 1."""
    done = run(tmp_path, CASES)
    assert done.returncode == 1
    assert "2 passed, 1 failed, 1 not tried, 1 not offered" in done.stdout


def test_a_failure_is_one_for_every_target(tmp_path: Path) -> None:
    """A case without a mark that fails is a failure for every target; its title and remark stand as they are."""
    done = run(tmp_path, CASES + BAD, "--target", "rosbridge_suite")
    assert done.returncode == 1
    assert "It fails. [[red]]" in done.stdout
    assert "assert 'this' == 'that'" in done.stdout


def test_an_unreachable_server_is_reported_in_a_sentence(tmp_path: Path) -> None:
    """An address without a listener ends the run with status 2 and an error."""
    cases = "def test_it(server):\n    pass\n"
    done = run(tmp_path, cases, "--url", "ws://127.0.0.1:1")
    assert done.returncode == 2
    assert "ws://127.0.0.1:1 can't be reached" in done.stdout


def test_cases_of_the_spec_alone_are_no_failures_of_the_target(tmp_path: Path) -> None:
    """This includes failures of their fixtures and cleanups. Without the target named they are failures."""
    done = run(tmp_path, SPEC_CASES, "--target", "rosbridge_suite")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 passed, 3 spec only" in done.stdout
    assert "a rule of this project's SPEC, not of rosbridge v2" in done.stdout.replace("\n", " ")
    assert run(tmp_path, SPEC_CASES).returncode == 1


def test_after_a_server_hangs_the_cases_that_are_left_are_not_tried(tmp_path: Path) -> None:
    """Each would only take time; the remark says since when."""
    with FakeServer(tmp_path / "again") as server:
        done = run(tmp_path, HANGS, "--url", server.url, "--answers-within", "1")
    assert done.returncode == 1
    assert "1 passed, 1 failed, 2 not tried" in done.stdout
    assert "since test_hang" in " ".join(done.stdout.split())


def test_a_server_that_hangs_is_started_again_by_a_command(tmp_path: Path) -> None:
    """The remaining cases are tried then."""
    again = tmp_path / "again"
    with FakeServer(again) as server:
        restart = f"touch {shlex.quote(str(again))}"
        done = run(tmp_path, HANGS, "--url", server.url, "--answers-within", "1", "--restart", restart)
    assert "3 passed, 1 failed" in done.stdout


KILLS = """
from conformance_suite import case

@case("bad", "section 1")
def test_kill(client):
    client.send("kill rosapi")
    client.values("/rosapi/nodes")

@case("good", "section 2")
def test_later(client):
    client.lives()
"""
ASKS = """
from conformance_suite import case

@case("rosapi nodes", "section 1")
def test_nodes(client):
    client.values("/rosapi/nodes")

@case("good", "section 2")
def test_other(client):
    client.lives()
"""


def test_a_rosapi_that_died_is_noticed(tmp_path: Path) -> None:
    """Each case that asks it would only take time."""
    with FakeServer(tmp_path / "again") as server:
        done = run(tmp_path, KILLS, "--url", server.url, "--answers-within", "2")
    assert "1 failed, 1 not tried" in done.stdout
    assert "rosapi has not answered any more since test_kill" in " ".join(done.stdout.split())


def test_a_rosapi_that_died_is_started_again_by_a_command(tmp_path: Path) -> None:
    again = tmp_path / "again"
    with FakeServer(again) as server:
        restart = f"touch {shlex.quote(str(again))}"
        done = run(tmp_path, KILLS, "--url", server.url, "--answers-within", "2", "--restart", restart)
    assert "1 passed, 1 failed" in done.stdout


def test_without_a_rosapi_its_cases_are_not_tried(tmp_path: Path) -> None:
    with FakeServer(tmp_path / "again") as server:
        server.has_rosapi = False
        done = run(tmp_path, ASKS, "--url", server.url, "--answers-within", "2")
    assert "1 passed, 1 not tried" in done.stdout
    assert "rosapi did not answer at the start" in " ".join(done.stdout.split())


def test_each_file_has_a_fresh_server(tmp_path: Path) -> None:
    """The server is started again between two files."""
    (tmp_path / "test_before.py").write_text(ASKS)
    with FakeServer(tmp_path / "again") as server:
        restart = f"echo again >>{shlex.quote(str(tmp_path / 'restarts'))}"
        options = ["--url", server.url, "--answers-within", "2", "--restart", restart]
        done = run(tmp_path, ASKS, *options, str(tmp_path / "test_before.py"))
    assert "4 passed" in done.stdout
    assert (tmp_path / "restarts").read_text() == "again\n"


@pytest.mark.parametrize("message", ["the fixture node is of another version", "not to be seen"])
def test_a_fixture_node_that_does_not_match_is_reported_in_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, message: str
) -> None:
    """Before any case is tried."""
    answers = {"op": "publish", "msg": {"data": '{"version": 1}'}} if "version" in message else None
    monkeypatch.setattr(FakeServer, "_answer", lambda self, said: answers)
    with FakeServer(tmp_path / "again") as server:
        done = run(tmp_path, HANGS, "--url", server.url, "--answers-within", "1")
    assert done.returncode == 2
    assert message in done.stdout
