"""The portal in a tab that is hidden, stuck or frozen while somebody drives with it.

Chromium is told what to do by its own protocol (Chrome DevTools Protocol), not by a library for tests: those keep every
page looking as if it were in front, so that no tab is ever hidden.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

import relay_server
from bench.report import Unavailable
from tests.worlds.browser import chromium_path
from tests.worlds.driving import Drive
from tests.worlds.waiting import wait_for

ARGUMENTS = ["--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--remote-debugging-port=0"]
TURN_LEFT = {"key": "a", "code": "KeyA", "windowsVirtualKeyCode": 65}
STUCK_MS = 2000
USER, PASSWORD = "driver", "correct horse"

WHERE = "document.querySelector('[data-testid=%s]')"


class Refused(Exception):
    """The browser can't do this now: a page that is being loaded has nothing to ask yet."""


class Browser:
    """Chromium without a screen, and the connection that commands it."""

    def __init__(self, folder: Path, stack: contextlib.ExitStack) -> None:
        command = [chromium_path() or "", *ARGUMENTS, f"--user-data-dir={folder}", "about:blank"]
        self._process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        stack.callback(self._end)
        told = folder / "DevToolsActivePort"
        wait_for("the browser listens", lambda: told.exists() and len(told.read_text().split()) == 2, 60)
        port, path = told.read_text().split()
        self._numbers = itertools.count(1)
        self._connection: ClientConnection = stack.enter_context(
            connect(f"ws://127.0.0.1:{port}{path}", max_size=None, close_timeout=1)
        )

    def do(self, method: str, session: str = "", **parameters: Any) -> dict[str, Any]:
        """One command; its result."""
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters}
        self._connection.send(json.dumps(message | ({"sessionId": session} if session else {})))
        while True:
            answer = json.loads(self._connection.recv(timeout=30))
            if answer.get("id") == number:
                if "error" in answer:
                    raise Refused(f"{method}: {answer['error']['message']}")
                return dict(answer["result"])

    def page(self, address: str) -> tuple[str, str]:
        """A new tab in front of all others; its name and the session that commands it."""
        name = self.do("Target.createTarget", url=address)["targetId"]
        return name, self.do("Target.attachToTarget", targetId=name, flatten=True)["sessionId"]

    def signal(self, number: int) -> None:
        """To all processes of it."""
        os.killpg(self._process.pid, number)

    def _end(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            self.signal(signal.SIGCONT)
            self.signal(signal.SIGTERM)
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self.signal(signal.SIGKILL)
            self._process.wait()


class Tab:
    """The cockpit, whose driver holds the key that turns the robot to the left."""

    def __init__(self, drive: Drive, browser: Browser) -> None:
        self._drive = drive
        self._browser = browser
        url = f"http://127.0.0.1:{drive.relay.http_port}"
        self._name, self._session = browser.page(f"{url}/login")
        login = json.dumps({"user": USER, "password": PASSWORD})
        asked = f"fetch('/api/v1/session', {{method: 'POST', body: JSON.stringify({login}), headers: "
        self._until(f"{asked}{{'Content-Type': 'application/json'}}}}).then(answer => answer.ok)")
        self._cockpit = f"{url}/cockpit/rover"

    @staticmethod
    @contextlib.contextmanager
    def opened(drive: Drive) -> Iterator[Tab]:
        """One, for as long as it is needed.

        :raises Unavailable: there is no Chromium, or no portal to open
        """
        if chromium_path() is None:
            raise Unavailable("no Chromium (Debian: apt install chromium-headless-shell)")
        if not (relay_server.PORTAL / "index.html").is_file():
            raise Unavailable("the portal is not built (make web)")
        with (
            tempfile.TemporaryDirectory(prefix="bench-", ignore_cleanup_errors=True) as folder,
            contextlib.ExitStack() as stack,
        ):
            yield Tab(drive, Browser(Path(folder), stack))

    def drive(self) -> None:
        """Open the cockpit anew, take control, and turn until the robot does."""
        self._do("Page.navigate", url=self._cockpit)
        self._until("document.visibilityState === 'visible'")
        control = WHERE % "control"
        take = WHERE % "control-take"
        self._until(f"{control} !== null && ({take}?.click(), {control}.dataset.standing === 'yours')")
        # A robot whose daemon has just begun may not have told its topics yet, and a key that is held is pressed once.
        self._until(f"{WHERE % 'drive-blocked'} === null && {WHERE % 'joystick'} !== null")
        self._until("document.activeElement.blur() || true")
        self._do("Input.dispatchKeyEvent", type="rawKeyDown", **TURN_LEFT)
        wait_for("the robot turns", self._drive.robot.moving)
        enough = len(self._drive.robot.events("command")) + 5
        wait_for("it is driven", lambda: len(self._drive.robot.events("command")) >= enough)

    def hide(self) -> None:
        """Another tab comes in front."""
        self._browser.do("Target.createTarget", url="about:blank")

    def get_stuck(self) -> None:
        """Its script does nothing else for a while; nobody waits for the answer."""
        wait = f"setTimeout(() => {{ const end = Date.now() + {STUCK_MS}; while (Date.now() < end); }})"
        self._do("Runtime.evaluate", expression=wait)

    def freeze(self) -> None:
        """The whole browser stands still, as on a machine that goes to sleep."""
        self._browser.signal(signal.SIGSTOP)

    def recover(self) -> None:
        """All is as before, and the key still held."""
        self._browser.signal(signal.SIGCONT)
        for each in self._browser.do("Target.getTargets")["targetInfos"]:
            if each["type"] == "page" and each["targetId"] != self._name:
                self._browser.do("Target.closeTarget", targetId=each["targetId"])
        self._browser.do("Target.activateTarget", targetId=self._name)
        self._until("true")  # behind whatever it was stuck with

    def let_go(self) -> None:
        """The key comes up."""
        self._do("Input.dispatchKeyEvent", type="keyUp", **TURN_LEFT)
        self._drive.stands()

    def _do(self, method: str, **parameters: Any) -> dict[str, Any]:
        return self._browser.do(method, self._session, **parameters)

    def _until(self, expression: str) -> None:
        """Wait until the page finds this true."""

        def found() -> bool:
            ask = {"expression": expression, "awaitPromise": True, "returnByValue": True}
            try:
                return self._do("Runtime.evaluate", **ask)["result"].get("value") is True
            except Refused:
                return False

        wait_for(f"on the page: {expression}", found, 30)


FAULTS: dict[str, Callable[[Tab], None]] = {
    "tab hidden behind another": Tab.hide,
    "tab's script stuck": Tab.get_stuck,
    "browser frozen (SIGSTOP)": Tab.freeze,
}
"""What happens to it."""


def struck(tab: Tab, fault: Callable[[Tab], None]) -> int:
    """Let it happen; when that was, monotonic nanoseconds."""
    at = time.monotonic_ns()
    fault(tab)
    return at
