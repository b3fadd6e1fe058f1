"""Files of a robot, with a real relay and a real daemon: uploaded, listed, downloaded, deleted."""

from __future__ import annotations

import hashlib
import json
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from playwright.sync_api import Browser, expect

from robot_client.device_state.rules import RULES
from robot_client.offload import Device
from tests.worlds.accessibility import violations
from tests.worlds.browser import checked_pages, open_session
from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.file_daemon import PRESSURE, file_daemon
from tests.worlds.forked_programs import run_command
from tests.worlds.http_requests import Answer, ask
from tests.worlds.processes import BIN, running
from tests.worlds.relay_process import Relay
from tests.worlds.waiting import wait_for

FILES = "/api/v1/robots/rover/files"
SETTINGS = """
[safety]
guard = false

[[file_group]]
name = "bags"
folder = "{folder}/bags"
patterns = ["*.bag"]
settle_seconds = 0.5
after = "delete"

[[file_group]]
name = "maps"
folder = "{folder}/maps"
settle_seconds = 0.5

[[file_group]]
name = "logs"
folder = "{folder}/logs"
settle_seconds = 0.5
after = "delete"
when = "full"
"""


class World:
    """A relay, and a daemon that dials it through a proxy."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.relay = Relay(folder, "--files-reserve-gb", "0")
        self.proxy = ChaosProxy(self.relay.robots_port)
        self.ann = self.relay.user("ann")
        self.bob = self.relay.user("bob")
        code = self.relay.cli("robot", "add", "rover")["enrolment_code"]
        self.relay.cli("right", "grant", "ann", "rover", "owner")
        self.relay.cli("right", "grant", "bob", "rover", "viewer", "--deny", "download:/bags/*")
        self.state = folder / "state"
        command = [str(BIN / "switchboard-robot"), "enroll", "--relay", f"127.0.0.1:{self.proxy.port}"]
        command += ["--robot", "rover", "--code", "-", "--state", str(self.state)]
        run_command(command, stdin=code).check_returncode()
        for each in ("bags", "maps", "logs"):
            (folder / each).mkdir()
        (folder / "robot.toml").write_text(SETTINGS.format(folder=folder))
        self.start_daemon()

    def start_daemon(self, **settings: str) -> None:
        self.daemon = file_daemon(self.state, self.folder / "robot.toml", self.folder, **settings)

    def files(self, token: str = "") -> list[dict[str, Any]]:
        answer = ask(self.relay.http_port, "GET", FILES, token=token or self.ann)
        assert answer.status == 200, answer.body
        return list(answer.json["files"])

    def names(self, token: str = "") -> list[str]:
        return [str(each["name"]) for each in self.files(token)]

    def get(self, name: str, token: str = "", method: str = "GET", **headers: str) -> Answer:
        path = f"{FILES}/{quote(name)}"
        return ask(self.relay.http_port, method, path, token=token or self.ann, headers=headers)

    def stop(self) -> None:
        self.daemon.stop()
        self.proxy.close()
        self.relay.stop()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    made = World(tmp_path_factory.mktemp("files"))
    with running(made):
        yield made


def test_a_group_is_uploaded_listed_and_downloaded(world: World) -> None:
    content = random.Random(1).randbytes(300_000)
    path = world.folder / "bags" / "straße 1.bag"
    path.write_bytes(content)
    (world.folder / "bags" / "notes.txt").write_text("not of the group")
    (world.folder / "maps" / "hall.yaml").write_text("resolution: 0.05")
    wait_for("both are stored", lambda: world.names() == ["bags/straße 1.bag", "maps/hall.yaml"])
    wait_for("the bag is deleted on the robot", lambda: not path.exists())
    assert (world.folder / "maps" / "hall.yaml").exists()
    info = world.files()[0]
    assert (info["size"], info["origin"]) == (len(content), "bags")
    assert info["sha256"] == hashlib.sha256(content).hexdigest()
    whole = world.get(info["name"])
    assert whole.status == 200
    assert whole.body == content
    assert whole.headers["ETag"] == f'"{info["sha256"]}"'
    assert whole.headers["Content-Disposition"] == (
        "attachment; filename=\"stra_e 1.bag\"; filename*=UTF-8''stra%C3%9Fe%201.bag"
    )
    part = world.get(info["name"], Range="bytes=1000-1999")
    assert part.status == 206
    assert part.body == content[1000:2000]
    assert world.get(info["name"], Range="bytes=300000-").status == 416


def test_the_device_manager_is_seen_at_the_relay_and_in_a_file(world: World) -> None:
    path = "/api/v1/robots/rover/device"
    wait_for(
        "the relay has readings",
        lambda: ask(world.relay.http_port, "GET", path, token=world.bob).status == 200,
    )
    device = ask(world.relay.http_port, "GET", path, token=world.bob).json
    assert 0 < device["readings"]["memory"] <= 100
    assert set(device["critical"]) == set(RULES)
    published = json.loads((world.state / "device.json").read_bytes())
    assert set(published) == {"at", "critical", "readings", "where"}


def test_rights_hide_files(world: World) -> None:
    wait_for("both are stored", lambda: len(world.names()) == 2)
    assert world.names(world.bob) == ["maps/hall.yaml"]
    assert world.get("bags/straße 1.bag", world.bob).status == 404
    assert world.get("maps/hall.yaml", world.bob).status == 200
    assert world.get("maps/hall.yaml", world.bob, method="DELETE").status == 403
    assert world.get("maps/none", method="DELETE").status == 404
    assert world.get("../../relay-data/relay.db").status == 404


def test_files_on_the_command_line(world: World) -> None:
    source = world.folder / "plan.txt"
    source.write_bytes(b"drive to the dock")
    cli, target = world.relay.cli, world.folder / "copy.txt"
    assert cli("file", "put", "rover", str(source), "--name", "plans/today")["size"] == 17
    assert "plans/today" in [each["name"] for each in cli("file", "list", "rover")]
    assert world.get("plans/today").body == b"drive to the dock"
    world.relay.run_cli("file", "get", "rover", "plans/today", "--output", str(target)).check_returncode()
    assert target.read_bytes() == b"drive to the dock"
    assert cli("file", "remove", "rover", "plans/today", "--yes") == {"removed": 1}
    assert world.get("plans/today").status == 404


def test_an_owner_uploads_a_file_in_parts(world: World) -> None:
    content = random.Random(2).randbytes(9_000_000)
    sha256 = hashlib.sha256(content).hexdigest()
    path = f"{FILES}/{quote('plans/straße.bin')}?sha256={sha256}"

    def put(token: str, start: int, stop: int) -> Answer:
        place = {"Content-Range": f"bytes {start}-{stop - 1}/{len(content)}"}
        part = content[start:stop]
        return ask(world.relay.http_port, "PUT", path, token=token, headers=place, body=part)

    assert put(world.bob, 0, 1000).status == 403
    assert put(world.ann, 0, 8_000_000).json["received"] == 8_000_000
    assert put(world.ann, 8_500_000, 9_000_000).json["received"] == 8_000_000
    stored = put(world.ann, 8_000_000, 9_000_000)
    assert (stored.status, stored.json["sha256"]) == (201, sha256)
    assert stored.json["origin"] == "user:ann"
    assert world.get("plans/straße.bin").body == content
    assert world.get("plans/straße.bin", method="DELETE").status == 204


def test_files_and_the_device_in_the_portal(world: World, browser: Browser) -> None:
    content = random.Random(3).randbytes(3_000_000)
    with checked_pages(browser, f"http://127.0.0.1:{world.relay.http_port}", 60) as new_page:
        page = new_page(1280, 900)
        open_session(page, "ann", "correct horse")
        page.goto("/files")
        # The only robot is selected.
        page.wait_for_url("**/files/rover")
        page.get_by_test_id("files-folder").fill("plans")
        chosen = {"name": "big.bin", "mimeType": "application/octet-stream", "buffer": content}
        page.get_by_test_id("files-choose").set_input_files([chosen])
        file = page.locator('[data-testid="file"][data-name="plans/big.bin"]')
        expect(file).to_have_count(1, timeout=60_000)
        expect(page.get_by_test_id("upload")).to_have_count(0)
        assert world.get("plans/big.bin").body == content
        for width in (1280, 390):
            page.set_viewport_size({"width": width, "height": 900})
            assert violations(page) == []
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        page.get_by_test_id("files-filter").fill("nothing/")
        expect(page.get_by_test_id("files-empty")).to_be_visible()
        page.get_by_test_id("files-filter").fill("plans/")
        with page.expect_download() as download:
            file.get_by_test_id("file-download").click()
        assert Path(download.value.path()).read_bytes() == content
        file.get_by_test_id("file-delete").click()
        file.get_by_test_id("file-delete-sure").click()
        expect(file).to_have_count(0, timeout=60_000)
        page.goto("/cockpit/rover")
        expect(page.locator('[data-testid="device-reading"][data-name="memory"]')).to_contain_text("%")
        assert violations(page) == []


def test_no_file_is_lost_when_daemon_and_relay_are_killed_while_they_are_uploaded(world: World) -> None:
    contents = {
        f"cut{number}.bag": random.Random(number).randbytes(400_000 * number) for number in range(1, 5)
    }
    whole = sum(map(len, contents.values()))
    hashes = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
    paths = {name: world.folder / "bags" / name for name in contents}
    world.proxy.squeeze(16e6)
    for name, content in contents.items():
        paths[name].write_bytes(content)
    begin = world.proxy.up
    for share, killed in ((0.1, "daemon"), (0.3, "relay"), (0.6, "daemon"), (0.9, "relay")):
        wait_for(
            "parts are sent",
            lambda share=share: (
                world.proxy.up - begin >= share * whole or not any(map(Path.exists, paths.values()))
            ),
        )
        if killed == "daemon":
            world.daemon.kill()
            world.start_daemon()
        else:
            world.relay.kill()
            world.relay.start()
        gone = {name for name, path in paths.items() if not path.exists()}
        stored = {each["name"]: each["sha256"] for each in world.files()}
        assert {f"bags/{name}": hashes[name] for name in gone}.items() <= stored.items()
    world.proxy.squeeze(None)
    wait_for("all are confirmed", lambda: not any(path.exists() for path in paths.values()))
    for name, content in contents.items():
        assert world.get(f"bags/{name}").body == content
        assert world.get(f"bags/{name}", method="DELETE").status == 204


def test_a_device_whose_memory_is_full_uploads_its_files_and_says_so(world: World) -> None:
    log, content = world.folder / "logs" / "drive.log", random.Random(5).randbytes(100_000)
    log.write_bytes(content)
    (world.folder / "bags" / "later.bag").write_bytes(b"a bag")
    wait_for("the bag is stored", lambda: "bags/later.bag" in world.names())
    assert log.exists()
    assert "logs/drive.log" not in world.names()
    assert not Device(world.state).critical("memory")
    world.daemon.stop()
    world.start_daemon(**PRESSURE)
    wait_for("the log is confirmed and deleted", lambda: not log.exists())
    assert world.get("logs/drive.log").body == content
    assert Device(world.state).critical("memory")
    path = "/api/v1/robots/rover/device"
    wait_for(
        "the relay knows it",
        lambda: ask(world.relay.http_port, "GET", path, token=world.ann).json["critical"]["memory"],
    )
    wait_for(
        "an alert says so",
        lambda: (
            b"memory is critical" in ask(world.relay.http_port, "GET", "/api/v1/alerts", token=world.ann).body
        ),
    )
    for name in ("logs/drive.log", "bags/later.bag"):
        assert world.get(name, method="DELETE").status == 204


def test_an_owner_deletes_a_file(world: World) -> None:
    wait_for("both are stored", lambda: "bags/straße 1.bag" in world.names())
    assert world.get("bags/straße 1.bag", method="DELETE").status == 204
    assert world.names() == ["maps/hall.yaml"]
    assert world.get("bags/straße 1.bag").status == 404
    actions = [each["action"] for each in world.relay.cli("audit", "list")]
    assert "file.delete" in actions
    assert "file.download" in actions
