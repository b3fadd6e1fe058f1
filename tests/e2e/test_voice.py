"""Spoken words move a robot: eSpeak NG speaks, the program recognises, and relay, daemon and simulator
execute.
"""

from __future__ import annotations

import os
import sys
import time
import wave
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.worlds.piped_process import PipedProcess
from tests.worlds.processes import Process, running
from tests.worlds.speech import RATE, SimulatedMicrophone, spaced, speech
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

SECONDS = "0.6"
"""How long a word acts here."""

ABSENCE = 0.7
"""Seconds that prove an absence: a word is obeyed after half of that."""


class VoiceWorld:
    """A robot with voice control."""

    def __init__(self, folder: Path, world: Any) -> None:
        self.folder = folder
        self.world = world
        self.relay = world.relay
        self.robot = world.robot
        self.token = world.operator
        self._runs = 0

    @property
    def environment(self) -> dict[str, str]:
        """The environment of the program."""
        return {**os.environ, "SWITCHBOARD_TOKEN": self.token}

    def command(self, *options: str) -> list[str]:
        """The command line of the program."""
        module = [sys.executable, "-u", "-m", "robot_client.apps.voice", self.relay.url("rover")]
        return [*module, "--seconds", SECONDS, *options]

    def listening(self) -> tuple[PipedProcess, SimulatedMicrophone]:
        """The program, with speech on its standard input."""
        self._runs += 1
        voice = PipedProcess(
            self.command("--pcm"), self.folder / "voice", f"voice{self._runs}", self.environment
        )
        voice.wait_to_say("listening")
        return voice, SimulatedMicrophone(os.dup(voice.feed))

    def moved(self, since: int, ahead: float, left: float) -> bool:
        """Whether a command with these directions was executed."""
        commands = self.robot.events("command", since)
        return any(np.sign(each["v"]) == ahead and np.sign(each["w"]) == left for each in commands)

    def stands(self) -> None:
        """Waits until the robot stands after a zero command."""

        def stands() -> bool:
            last = self.robot.events("command")[-1]
            return not self.robot.moving() and (last["v"], last["w"]) == (0.0, 0.0)

        wait_for("the robot stands", stands)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory, world: Any) -> VoiceWorld:
    """One for all tests."""
    return VoiceWorld(tmp_path_factory.mktemp("scene"), world)


def test_words_move_the_robot_and_noise_does_not(scene: VoiceWorld) -> None:
    """For a short time; *stop* is the relay's stop while the program has not needed control."""
    scene.world.left_alone()
    voice, microphone = scene.listening()
    with scene.relay.connect("rover", scene.token) as client, running(voice, microphone):
        microphone.start()
        microphone.say(speech("purple elephant"))
        microphone.say(np.random.default_rng(1).normal(0, 6000, RATE // 2).astype(np.int16))
        since = time.monotonic_ns()
        time.sleep(ABSENCE)  # no command must arrive meanwhile
        assert scene.robot.events("command", since) == []
        microphone.say(speech("stop"))
        client.send(op="subscribe", topic="/relay/control")
        reported = wait_for("the robot is stopped", lambda: stopped(client))
        assert reported["holder"] is None
        assert client.call("/relay/take_control")["values"]["success"]
        wait_for("it is resumed", lambda: client.call("/relay/resume")["result"])
        assert client.call("/relay/release_control")["values"]["success"]
        since = microphone.say(speech("ahead"))
        wait_for("it goes ahead", lambda: scene.moved(since, 1, 0))
        scene.stands()
        wait_for("it has control", lambda: client.until(op="publish")["msg"]["holder"])
        assert voice.stop() == 0
        wait_for("control is given back", lambda: client.until(op="publish")["msg"]["holder"] is None)


def stopped(client: Client) -> Any:
    """The next control message, if the robot is stopped by then."""
    reported = client.until(op="publish")["msg"]
    return reported if reported["stopped"] else None


def test_a_file_is_recognised_to_its_end(scene: VoiceWorld) -> None:
    """The program ends when the last word has been executed."""
    path = scene.folder / "orders.wav"
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(RATE)
        file.writeframes(spaced(speech("right"), gap=0.5).tobytes())
    since = time.monotonic_ns()
    voice = Process(scene.command("--wav", str(path)), scene.folder, "file", scene.environment)
    with running(voice):
        assert voice.popen.wait(60) == 0
    assert scene.moved(since, 0, -1)
    assert voice.said().splitlines()[-3:] == ["right", "stands", "ended"]
    scene.stands()
