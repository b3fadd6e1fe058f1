"""The examples of two documents work literally: a range sensor and a base; commands by TCP with their client."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Range

from robot_client import config
from robot_client.modules.settings import ModuleSettings
from tests.worlds.python_module import PythonModule
from tests.worlds.ros_domains import free_domain
from tests.worlds.serial_terminal import SerialTerminal
from tests.worlds.service_process import TopicWatcher

DOCUMENTS = Path(__file__).parents[3] / "docs/guides"


def blocks(language: str) -> list[str]:
    text = "".join((DOCUMENTS / name).read_text() for name in ("devices.md", "remote_goals.md"))
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


SENSOR, BASE, CLIENT = blocks("python")
SETTINGS = blocks("toml")


class World:
    def __init__(self, folder: Path, domain: int) -> None:
        self.folder = folder
        self.environment = {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        self.watcher = TopicWatcher(domain)
        self.running: list[PythonModule] = []
        package = folder / "my_robot"
        package.mkdir()
        (package / "range_sensor.py").write_text(SENSOR)
        (package / "base.py").write_text(BASE)

    def settings(self, name: str) -> ModuleSettings:
        """Settings of a module, as in the document."""
        path = self.folder / "robot.toml"
        path.write_text(next(each for each in SETTINGS if f'name = "{name}"' in each))
        return next(each for each in config.load(path, {}).module if each.name == name)

    def start(self, name: str, **changed: Any) -> PythonModule:
        own = self.settings(name)
        settings = {**own.settings, **changed}
        assert set(settings) == set(own.settings)
        made = PythonModule(
            self.folder / "modules",
            own.python,
            name=name,
            environment=self.environment,
            cwd=self.folder,
            **settings,
        )
        self.running.append(made)
        made.ready()
        made.daemon.send("stopped", stopped=False)
        return made


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        made = World(tmp_path_factory.mktemp("devices"), free_domain())
        yield made
        for each in made.running:
            each.kill()
        made.watcher.close()


def test_device_in_30_lines(world: World) -> None:
    assert len([line for line in SENSOR.splitlines() if line]) <= 30
    device = SerialTerminal(world.folder)
    module = world.start("range", port=str(device.path))
    world.watcher.watch("/range", Range)
    found = world.watcher.newest("/range", meanwhile=lambda: device.send(b"damaged\r\n1.5\r\n"))
    assert (found.range, found.header.frame_id) == (1.5, "front")
    assert module.daemon.command({"rate": 5}) == ""
    device.until(b"rate 5\n")
    assert module.daemon.command({"rate": 7}) == "a command is {'rate': 1}, 5 or 10"
    assert module.stop()["code"] == 0


def test_base(world: World) -> None:
    controller = SerialTerminal(world.folder)
    module = world.start("base", port=str(controller.path))
    world.watcher.watch("/odom", Odometry, qos_profile_sensor_data)
    publisher = world.watcher.node.create_publisher(Twist, "/cmd_vel", 1)
    command = Twist()
    command.linear.x = 0.35
    counts = iter(range(65_000, 10**9, 100))

    def drives() -> None:
        publisher.publish(command)
        ticks = next(counts) % 2**16
        controller.send(b"E %d %d\n" % (ticks, ticks))

    # The counters restart during the drive.
    found = world.watcher.newest(
        "/odom", lambda message: message.pose.pose.position.x > 0.2, meanwhile=drives
    )
    assert abs(found.pose.pose.position.y) < 1e-6 and found.pose.pose.position.x < 10
    controller.until(b"V 10.000 10.000\n")
    # Commands have ended.
    controller.until(b"V 0.000 0.000\n")
    assert module.stop()["code"] == 0
    shutil.rmtree(module.folder)


def test_base_that_was_unplugged_when_the_robot_was_stopped_stands_still_when_it_is_back(
    world: World,
) -> None:
    controller = SerialTerminal(world.folder)
    module = world.start("base", port=str(controller.path))
    publisher = world.watcher.node.create_publisher(Twist, "/cmd_vel", 1)
    command = Twist()
    command.linear.x = 0.35
    received = bytearray()

    def driven() -> bool:
        publisher.publish(command)
        received.extend(controller.waiting())
        return b"V 10.000 10.000\n" in received

    world.watcher.until("the base drives", driven)
    controller.unplug()
    module.daemon.send("stopped", stopped=True)
    # Its answer shows that the stop was carried out.
    assert module.daemon.command(1) == "this module takes no commands"
    controller.plug()
    controller.until(b"V 0.000 0.000\n")
    assert module.stop()["code"] == 0


def test_targets_by_tcp(world: World) -> None:
    """The client with the servers' documented settings; without a navigator the targets are refused with a
    reason.
    """
    secret = world.folder / "secret"
    secret.write_text("a secret of the test\n")
    secret.chmod(0o600)
    world.start("targets")
    for host, secret_file in (("0.0.0.0", [str(secret)]), ("127.0.0.1", [])):
        server = world.start("commands", port=0, host=host, secret_file="".join(secret_file))
        port = [each for each in server.texts() if "listening" in each][-1].rpartition(":")[2]
        done = subprocess.run(
            [sys.executable, "-c", CLIENT, "127.0.0.1", port, *secret_file],
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert done.returncode == 0, done.stderr
        assert "there is no navigator: no node has the action navigate_to_pose" in done.stdout
        server.kill()
        shutil.rmtree(server.folder)
    assert world.settings("speech").command == ["switchboard-robot-service", "speech"]
