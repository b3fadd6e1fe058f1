"""The applications: how long words, a stick, a tilt, a scan and a face take until the robot does what they mean.

Words are spoken by eSpeak NG into the standard input of ``voice``, as a microphone's samples come. The gamepad of
``joystick`` is SDL's virtual one. What counts is the simulated robot's own record, on the same clock. The bars are what
SOM4R's authors measured of such applications: 500 ms for words, 300 ms for a joystick's answer, 83 ms for a scan. Their
joystick was a phone that is tilted: so one is measured too, in the portal.

Whom ``greeting`` greets the measurement itself puts on the topic of the service ``faces``; what a look at a picture
takes that service is measured apart. ``recharge`` drives the simulated robot to its charger with the service
``markers``, turned to another side before each run.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from bench import ROOT, scanning, tilting
from bench.driving import first_move
from bench.relay import Relay
from bench.report import Options, Row, Unavailable
from tests.worlds.client_threads import Listener
from tests.worlds.piped_process import PipedProcess
from tests.worlds.processes import Process, ros_environment, running
from tests.worlds.robot_process import Robot
from tests.worlds.speech import SimulatedMicrophone, silence, speech
from tests.worlds.sync_client import Client
from tests.worlds.touch import OBEYED_SECONDS
from tests.worlds.waiting import wait_for

HAND = ROOT / "tests" / "e2e" / "clients" / "joystick_in_hand.py"
HOLD, LEFT_Y = 10, 1
USER, PASSWORD = "driver", "correct horse"
WORD_BAR_MS, STICK_BAR_MS, SCAN_BAR_MS = 500, 300, 83
FAILED = 180.0
"""Seconds after which a robot has not reached its charger."""
CHARGING = 1
REST = 0.3
"""Seconds that the robot stands between two measurements: its odometry has to have said so."""


class Odometry(Listener):
    """When the robot's odometry first said that it moves."""

    def __init__(self, client: Client) -> None:
        super().__init__(client)
        self._moves = threading.Event()
        self._at = 0
        client.send(op="subscribe", topic="/odom", type="nav_msgs/msg/Odometry")

    def take(self, message: dict[str, Any]) -> None:
        """Look at it."""
        if message["op"] == "publish" and message["msg"]["twist"]["twist"]["linear"]["x"] > 0:
            if not self._moves.is_set():
                self._at = time.monotonic_ns()
            self._moves.set()

    def forget(self) -> None:
        """From now on the next movement counts."""
        self._moves.clear()

    def moved_at(self) -> int:
        """Monotonic nanoseconds."""
        assert self._moves.wait(60), "the odometry does not say that the robot moves"
        return self._at


class Said(Listener):
    """When the robot was told to say something."""

    def __init__(self, client: Client) -> None:
        super().__init__(client)
        self.at: dict[str, int] = {}
        client.send(op="advertise", topic="/faces/seen", type="std_msgs/msg/String")
        client.send(op="subscribe", topic="/say", type="std_msgs/msg/String")

    def take(self, message: dict[str, Any]) -> None:
        """Write it down."""
        if message["op"] == "publish":
            self.at[message["msg"]["data"]] = time.monotonic_ns()

    def show(self, name: str) -> None:
        """A picture with somebody in it."""
        seen = {"stamp": time.time(), "frame": "camera", "faces": [{"name": name}]}
        self.client.send(op="publish", topic="/faces/seen", msg={"data": json.dumps(seen)})


def _rest(robot: Robot) -> None:
    wait_for("the robot stands", lambda: not robot.moving())
    time.sleep(REST)


def words(relay: Relay, robot: Robot, environment: dict[str, str], runs: int, first: int = 0) -> list[float]:
    """Milliseconds from the end of a word to the command that the robot carried out.

    :param first: the number of the first; what has number 0 is not counted
    """
    command = [
        sys.executable,
        "-m",
        "robot_client.apps.voice",
        relay.url("rover"),
        "--pcm",
        "--seconds",
        "0.4",
    ]
    voice = PipedProcess(command, relay.folder, "voice", environment)
    voice.wait_to_say("listening")
    mouth = SimulatedMicrophone(os.dup(voice.feed))
    took = []
    with running(voice, mouth):
        mouth.start()
        mouth.say(silence(REST))  # what is silence here is heard before the first word
        for number in range(first, runs + 1):
            ended = mouth.say(speech(("ahead", "right", "left")[number % 3]))
            came = wait_for(
                "the word is obeyed", lambda ended=ended: first_move(robot.events("command", ended))
            )
            if number:  # with number 0 control was taken, and the robot's guard got ready
                took.append((came - ended) / 1e6)
            _rest(robot)
    return took


def sticks(
    relay: Relay, robot: Robot, environment: dict[str, str], runs: int, first: int = 0
) -> tuple[list[float], list[float]]:
    """Milliseconds from a push of the stick to the command, and to odometry of it that a client hears."""
    token = environment["SWITCHBOARD_TOKEN"]
    pad = PipedProcess([sys.executable, str(HAND), relay.url("rover")], relay.folder, "pad", environment)
    pad.wait_to_say("no gamepad")
    odometry = Odometry(relay.connect("rover", token))
    commands, seen = [], []
    with running(pad, odometry):
        odometry.start()
        pad.tell("plug")
        pad.wait_to_say("press the button")
        for word in ("you have control", "driving"):
            pad.tell(f"button {HOLD} 1")
            pad.wait_to_say(word)
            if word != "driving":
                pad.tell(f"button {HOLD} 0")
                pad.wait_to_say("hold the button")
        for number in range(first, runs + 1):
            odometry.forget()
            pushed = time.monotonic_ns()
            pad.tell(f"axis {LEFT_Y} -1")
            came = wait_for(
                "the stick is obeyed", lambda pushed=pushed: first_move(robot.events("command", pushed))
            )
            if number:  # until number 0 the robot's guard got ready
                commands.append((came - pushed) / 1e6)
                seen.append((odometry.moved_at() - pushed) / 1e6)
            pad.tell(f"axis {LEFT_Y} 0")
            _rest(robot)
    return commands, seen


def greetings(relay: Relay, environment: dict[str, str], runs: int) -> list[float]:
    """Milliseconds from the second picture with somebody in it to the words that the robot is to say."""
    command = [sys.executable, "-m", "robot_client.apps.greeting", relay.url("rover"), "--text", "{name}"]
    program = Process(command, relay.folder, "greeting", environment)
    program.wait_to_say("looking for people")
    said = Said(relay.connect("rover", environment["SWITCHBOARD_TOKEN"]))
    took = []
    with running(program, said):
        said.start()

        def known() -> bool:
            said.show("somebody")
            time.sleep(REST)
            return "somebody" in said.at

        wait_for("the topics have found each other", known)
        for number in range(runs):
            name = f"person {number}"
            said.show(name)
            time.sleep(REST)  # so long the next picture takes
            seen = time.monotonic_ns()
            said.show(name)
            wait_for("the greeting is said", lambda name=name: name in said.at)
            took.append((said.at[name] - seen) / 1e6)
    return took


def looks(runs: int) -> list[float]:
    """Milliseconds that the service ``faces`` takes for a picture of 640 × 480 with a face that it knows."""
    import cv2
    from skimage import data

    from robot_client.services.camera_model import of_view
    from robot_client.services.faces import FaceFinder, KnownFaces, find_faces, grey_of

    cv2.setNumThreads(1)
    pixels = np.full((480, 640, 3), 110, np.uint8)
    pixels[:, :512] = data.astronaut()[:480, :, ::-1]
    finder, people, lens = FaceFinder(), KnownFaces(), of_view(640, 480, 75)
    people.add("eileen", grey_of(pixels), finder.find(grey_of(pixels))[0])
    took = []
    for _ in range(runs):
        began = time.perf_counter()
        find_faces(pixels, lens, finder, people)
        took.append((time.perf_counter() - began) * 1000)
    return took


def recharges(relay: Relay, environment: dict[str, str], runs: int) -> list[float]:
    """Seconds from control over a robot with a low battery until it charges, of those runs in which it does."""
    robot = Robot(relay, "hungry", camera=True, sim_options=("--charge", "15"))
    relay.cli("right", "grant", USER, "hungry", "operator")
    see = [sys.executable, "-m", "robot_client.services.main", "markers", "--view", "75", "--size", "0.4"]
    markers = Process(see, relay.folder, "markers", ros_environment(robot.domain))
    client = relay.connect("hungry", environment["SWITCHBOARD_TOKEN"])
    took = []
    with running(robot, markers), client:
        markers.wait_to_say("READY")
        client.send(op="advertise", topic="/cmd_vel", type="geometry_msgs/msg/Twist")
        client.send(
            op="subscribe", topic="/battery_state", type="sensor_msgs/msg/BatteryState", queue_length=1
        )
        for number in range(runs):
            client.call("/reset")
            for _ in range(5 * number):
                client.drive(0.0, 1.0)
                time.sleep(0.1)
            client.drive(0.0)
            _rest(robot)
            client.call("/relay/release_control")
            took += _recharge(relay, client, environment, number)
    return took


def _recharge(relay: Relay, client: Client, environment: dict[str, str], number: int) -> list[float]:
    command = [sys.executable, "-m", "robot_client.apps.recharge", relay.url("hungry")]
    program = Process(command, relay.folder, f"recharge{number}", environment)
    with running(program):
        program.wait_to_say("looking for marker")
        began = time.monotonic()
        while time.monotonic() < began + FAILED:
            state = client.until(op="publish", topic="/battery_state")["msg"]["power_supply_status"]
            if state == CHARGING:
                return [time.monotonic() - began]
    return []


def _pair(what: str, took: list[float], bar: float | None = None, note: str = "") -> list[Row]:
    return [
        Row("apps", f"{what}, median", "ms", statistics.median(took), bar=bar, note=note),
        Row("apps", f"{what}, longest of {len(took)}", "ms", max(took)),
    ]


def _scanned(took: list[float]) -> list[Row]:
    what = f"avoidance: a robot's scan of {scanning.RAYS} rays, from its stamp until decided upon"
    note = (
        f"of {len(took)} scans of a simulated robot, by ROS 2, daemon, relay and websocket; the stamp is of before it "
        "looks"
    )
    return [
        Row("apps", f"{what}, median", "ms", statistics.median(took), bar=SCAN_BAR_MS, note=note),
        Row("apps", f"{what}, p95", "ms", sorted(took)[int(0.95 * (len(took) - 1))]),
    ]


def _tilted(relay: Relay, robot: Robot, environment: dict[str, str], runs: int, first: int) -> list[Row]:
    """A phone that is tilted. Without a browser or portal there are no rows."""
    with relay.connect(robot.name, environment["SWITCHBOARD_TOKEN"]) as client:
        client.call("/reset")  # room ahead, after all that was driven before
    try:
        found = tilting.tilts(relay, robot, USER, PASSWORD, runs, first)
    except Unavailable as reason:
        print(f"    not measured: tilt: {reason}", flush=True)
        return []
    note = f"tilt: {found.anew} were not obeyed within {OBEYED_SECONDS:g} s and done anew"
    return [
        *_pair("tilt: phone tilted → command carried out", found.commands, STICK_BAR_MS, note),
        *_pair("tilt: phone tilted → odometry of it is on its page", found.shown, STICK_BAR_MS),
    ]


def run(options: Options) -> list[Row]:
    """All of them."""
    runs, first = options.runs or int(options.pick(1, 60)), int(options.pick(1, 0))
    at_once = scanning.constant(runs * 20)
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        relay = Relay(Path(folder))
        with running(relay):
            robot = Robot(relay, "rover")
            with running(robot):
                token = relay.user(USER, PASSWORD)
                environment = {**os.environ, "SWITCHBOARD_TOKEN": token}
                relay.cli("right", "grant", USER, "rover", "operator")
                scanned = scanning.of_a_robot(relay, "rover", token, runs * 5)
                commands, seen = sticks(relay, robot, environment, runs, first)
                tilted = _tilted(relay, robot, environment, runs, first)
                heard = words(relay, robot, environment, runs, first)
                greeted = greetings(relay, environment, runs)
            drives = int(options.pick(0, 10))
            charged = recharges(relay, environment, drives) if drives else []
    rows = _pair(f"avoidance: a scan of {scanning.RAYS} rays read and decided upon", at_once, SCAN_BAR_MS)
    rows += _scanned(scanned)
    rows += _pair("joystick: stick pushed → command carried out", commands, STICK_BAR_MS)
    rows += _pair("joystick: stick pushed → odometry of it is back", seen, STICK_BAR_MS)
    rows += tilted
    rows += _pair("voice: end of the word → command carried out", heard, WORD_BAR_MS)
    rows += _pair("faces: a picture of 640×480 looked at", looks(runs))
    rows += _pair("greeting: second picture of somebody → what the robot is to say", greeted)
    rows.append(
        Row("apps", f"recharge: of {drives} runs without a charge", "runs", drives - len(charged), bar=0)
    )
    if charged:
        rows.append(
            Row("apps", "recharge: control taken → battery charges, median", "s", statistics.median(charged))
        )
    return rows
