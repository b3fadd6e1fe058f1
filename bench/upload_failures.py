"""``python -m bench.upload_failures``: what becomes of files when something dies at each moment of their upload.

A robot's daemon uploads a file of a group that is deleted on the robot once the relay has confirmed it. The moments are
spread evenly over the time that an undisturbed upload takes, from the writing of the file to its deletion. In the end
each file must be at the relay with the contents that were written. It is a trial, not a measurement: nothing is kept.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections import Counter
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any
from urllib.error import URLError

from bench.relay import Relay
from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.file_daemon import file_daemon
from tests.worlds.processes import BIN, running
from tests.worlds.waiting import wait_for

FAULTS = ("link", "relay", "daemon")
GOLDEN = 0.618034
SIZE = 24 * 1024 * 1024
PATIENCE = 180.0
SETTINGS = """
[safety]
guard = false

[[file_group]]
name = "bags"
folder = "{folder}"
settle_seconds = 0.2
after = "delete"
"""


class Scene:
    """A relay, and a robot with a group of files that reaches it by a proxy."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._folder = folder
        self.relay = Relay(folder, "--files-reserve-gb", "0")
        stack.enter_context(running(self.relay))
        self.proxy = ChaosProxy(self.relay.robots_port)
        stack.callback(self.proxy.close)
        self._state = folder / "device"
        code = self.relay.cli("robot", "add", "rover")["enrolment_code"]
        self._token = self.relay.user("ann", admin=True)
        enroll = [str(BIN / "switchboard-robot"), "enroll", "--relay", f"127.0.0.1:{self.proxy.port}"]
        enroll += ["--robot", "rover", "--code", "-", "--state", str(self._state)]
        subprocess.run(enroll, input=code, text=True, capture_output=True, timeout=60, check=True)
        self.bags = folder / "bags"
        self.bags.mkdir()
        (folder / "robot.toml").write_text(SETTINGS.format(folder=self.bags))
        self._start_daemon()
        stack.callback(lambda: self._daemon.stop())

    def _start_daemon(self) -> None:
        self._daemon = file_daemon(self._state, self._folder / "robot.toml", self._folder)

    def break_it(self, fault: str) -> None:
        """Something dies, and comes back."""
        if fault == "link":
            self.proxy.reset()
        elif fault == "relay":
            self.relay.kill()
            self.relay.start()
        else:
            self._daemon.kill()
            self._start_daemon()

    def get(self, path: str) -> bytes:
        """A resource of the robot's files.

        :raises OSError: the relay does not answer, or there is none
        """
        address = f"http://127.0.0.1:{self.relay.http_port}/api/v1/robots/rover/files{path}"
        request = urllib.request.Request(address, headers={"Authorization": f"Bearer {self._token}"})
        with urllib.request.urlopen(request, timeout=30) as answer:
            return bytes(answer.read())

    def listed(self, name: str) -> dict[str, Any] | None:
        """The file of this name, if the relay has it."""
        with suppress(URLError, OSError):
            for each in json.loads(self.get("?limit=500"))["files"]:
                if each["name"] == f"bags/{name}":
                    return dict(each)
        return None


def trial(at: Scene, fault: str, moment: float | None, number: int) -> tuple[str, float]:
    """How an upload ended, in words, and its seconds.

    :param moment: seconds after the file was written; ``None``: nothing dies
    """
    name, content = f"{fault}-{number}.bag", random.Random(f"{fault} {number}").randbytes(SIZE)
    path, wanted = at.bags / name, hashlib.sha256(content).hexdigest()
    path.write_bytes(content)
    began = time.monotonic()
    if moment is not None:
        time.sleep(moment)
        was_there = path.exists()
        at.break_it(fault)
    try:
        wait_for(f"{name} is deleted on the robot", lambda: not path.exists(), PATIENCE)
    except AssertionError:
        return "not uploaded", time.monotonic() - began
    took = time.monotonic() - began
    try:
        found = wait_for("the relay has it", lambda: at.listed(name), PATIENCE)
    except AssertionError:
        return "LOST", took
    if found["sha256"] != wanted or hashlib.sha256(at.get(f"/bags/{name}")).hexdigest() != wanted:
        return "LOST", took
    if moment is None:
        return "undisturbed", took
    return ("stored" if was_there else "stored before"), took


def main() -> int:
    """Try all; the code is 1 when a file was lost or not uploaded."""
    parser = argparse.ArgumentParser(prog="python -m bench.upload_failures", description=__doc__)
    parser.add_argument("faults", nargs="*", choices=[*FAULTS, []], help="all, if none is named")
    parser.add_argument("--runs", type=int, default=50, help="moments of each fault")
    asked = parser.parse_args()
    bad = 0
    with tempfile.TemporaryDirectory(prefix="bench-") as folder, ExitStack() as stack:
        at = Scene(Path(folder), stack)
        span = max(trial(at, "none", None, number)[1] for number in range(3))
        print(f"an undisturbed upload of {SIZE >> 20} MiB takes {span:.1f} s", flush=True)
        for fault in asked.faults or FAULTS:
            ends = [trial(at, fault, span * (run * GOLDEN % 1.0), run) for run in range(asked.runs)]
            counts = dict(Counter(each for each, _ in ends))
            bad += sum(not each.startswith("stored") for each, _ in ends)
            longest = max(took for _, took in ends)
            print(f"{fault} dies, {len(ends)} moments: {counts}, longest {longest:.1f} s", flush=True)
    return int(bad > 0)


if __name__ == "__main__":
    os.environ.setdefault("PYTHONUNBUFFERED", "1")
    sys.exit(main())
