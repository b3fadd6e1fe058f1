"""The portal's types of HTTP bodies are those of the relay, and so are the fake relay's answers."""

from __future__ import annotations

import json
import subprocess
import sys
import urllib.request
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from relay_server.alerts.schemas import AlertPage
from relay_server.fleet.order import RobotGroupList
from relay_server.http.logins import CurrentUser
from relay_server.recordings.service import Recordable, RecordingPage
from relay_server.sessions.presence import RobotInfo, RobotPage
from relay_server.video.parameters import CameraList

if TYPE_CHECKING:
    from tests.web_client.conftest import FakeRelay

ROOT = Path(__file__).parents[2]


def test_generated_types_are_those_of_todays_relay() -> None:
    document = ROOT / "build/openapi.json"
    document.parent.mkdir(exist_ok=True)
    with document.open("w") as file:
        subprocess.run([sys.executable, "scripts/openapi.py", "--types"], cwd=ROOT, stdout=file, check=True)
    npm = ["scripts/with-node.sh", "npm", "--silent", "--prefix", "web_client"]
    checked = subprocess.run(
        [*npm, "run", "api-types", "--", "--check"], cwd=ROOT, capture_output=True, text=True
    )
    assert checked.returncode == 0, (
        f"web_client/src/lib/api/schema.d.ts is out of date; run 'make api-types'\n{checked.stdout}{checked.stderr}"
    )


@pytest.mark.parametrize(
    ("path", "shape"),
    [
        ("/api/v1/session", CurrentUser),
        ("/api/v1/robots", RobotPage),
        ("/api/v1/robots/rover-1", RobotInfo),
        ("/api/v1/robots/rover-1/recordings", RecordingPage),
        ("/api/v1/robots/rover-1/recordings/new", Recordable),
        ("/api/v1/alerts", AlertPage),
        ("/api/v1/fleet/groups", RobotGroupList),
        ("/robots/rover-1/video/cameras", CameraList),
    ],
)
def test_the_fake_relay_answers_like_the_relay(relay: FakeRelay, path: str, shape: Any) -> None:
    relay.do(alert={"robot": "rover-1", "text": "main low"})
    headers = {"X-Requested-With": "switchboard", "Content-Type": "application/json"}
    login = json.dumps({"user": "admin", "password": "correct horse"}).encode()
    with urllib.request.urlopen(
        urllib.request.Request(f"{relay.url}/api/v1/session", login, headers)
    ) as answer:
        cookie = answer.headers["Set-Cookie"].partition(";")[0]
    with urllib.request.urlopen(
        urllib.request.Request(relay.url + path, headers={"Cookie": cookie})
    ) as answer:
        msgspec.json.decode(answer.read(), type=shape)
