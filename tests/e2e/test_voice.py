"""Spoken words move a robot: eSpeak NG speaks, the program hears, the relay, the daemon and the simulator obey."""

from __future__ import annotations

import os
import sys
import time
import wave
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from switchboard_client import Client
from switchboard_fed import Fed
from switchboard_processes import Process, running
from switchboard_speech import RATE, Mouth, spaced, speech
from switchboard_waiting import wait_for

SECONDS = "0.6"
"""How long a word acts here."""

ABSENCE = 0.7
"""Seconds that prove an absence: a word is obeyed after half of that."""


class Hall:
    """A robot that hears."""

    def __init__(self, folder: Path, world: Any) -> None:
        self.folder = folder
        self.world = world
        self.relay = world.relay
        self.robot = world.robot
        self.token = world.operator
        self._runs = 0

    @property
    def environment(self) -> dict[str, str]:
        """Of the program."""
        return {**os.environ, "SWITCHBOARD_TOKEN": self.token}

    def command(self, *options: str) -> list[str]:
        """The program."""
        module = [sys.executable, "-u", "-m", "robot_client.apps.voice", self.relay.url("rover")]
        return [*module, "--seconds", SECONDS, *options]

    def listening(self) -> tuple[Fed, Mouth]:
        """The program, and who speaks to it by its standard input."""
        self._runs += 1
        voice = Fed(self.command("--pcm"), self.folder / "voice", f"voice{self._runs}", self.environment)
        voice.wait_to_say("listening")
        return voice, Mouth(os.dup(voice.feed))

    def moved(self, since: int, ahead: float, left: float) -> bool:
        """Whether a command of these directions was carried out."""
        commands = self.robot.events("command", since)
        return any(np.sign(each["v"]) == ahead and np.sign(each["w"]) == left for each in commands)

    def stands(self) -> None:
        """Wait until the robot stands, by a zero that was said."""

        def stands() -> bool:
            last = self.robot.events("command")[-1]
            return not self.robot.moving() and (last["v"], last["w"]) == (0.0, 0.0)

        wait_for("the robot stands", stands)


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory, world: Any) -> Hall:
    """One for all."""
    return Hall(tmp_path_factory.mktemp("hall"), world)


def test_words_move_the_robot_and_noise_does_not(hall: Hall) -> None:
    """For a moment; *stop* is the relay's as long as nobody had to take control."""
    hall.world.left_alone()
    voice, mouth = hall.listening()
    with hall.relay.connect("rover", hall.token) as client, running(voice, mouth):
        mouth.start()
        mouth.say(speech("purple elephant"))
        mouth.say(np.random.default_rng(1).normal(0, 6000, RATE // 2).astype(np.int16))
        since = time.monotonic_ns()
        time.sleep(ABSENCE)  # so long nothing must come
        assert hall.robot.events("command", since) == []
        mouth.say(speech("stop"))
        client.send(op="subscribe", topic="/relay/control")
        told = wait_for("the robot is stopped", lambda: stopped(client))
        assert told["holder"] is None
        assert client.call("/relay/take_control")["values"]["success"]
        wait_for("it is resumed", lambda: client.call("/relay/resume")["result"])
        assert client.call("/relay/release_control")["values"]["success"]
        since = mouth.say(speech("ahead"))
        wait_for("it goes ahead", lambda: hall.moved(since, 1, 0))
        hall.stands()
        wait_for("it has control", lambda: client.until(op="publish")["msg"]["holder"])
        assert voice.stop() == 0
        wait_for("control is given back", lambda: client.until(op="publish")["msg"]["holder"] is None)


def stopped(client: Client) -> Any:
    """What is told next of control, if the robot is stopped by then."""
    told = client.until(op="publish")["msg"]
    return told if told["stopped"] else None


def test_a_file_is_heard_to_its_end(hall: Hall) -> None:
    """Then the program ends, when the last word has been done."""
    path = hall.folder / "orders.wav"
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(RATE)
        file.writeframes(spaced(speech("right"), gap=0.5).tobytes())
    since = time.monotonic_ns()
    voice = Process(hall.command("--wav", str(path)), hall.folder, "file", hall.environment)
    with running(voice):
        assert voice.popen.wait(60) == 0
    assert hall.moved(since, 0, -1)
    assert voice.said().splitlines()[-3:] == ["right", "stands", "ended"]
    hall.stands()
