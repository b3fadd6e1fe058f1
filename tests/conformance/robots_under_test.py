"""Robots for the link's cases without ``--listen``: the daemon on ROS 2 with the fixture node, and the
examples.
"""

from __future__ import annotations

import sys
from pathlib import Path

from link_relay import ENROLMENT_CODE, PATIENCE_TO_DIAL

from tests.worlds.processes import BIN, Process, ros_environment
from tests.worlds.ros_domains import free_domain

HERE = Path(__file__).parent
EXAMPLES = HERE.parents[1] / "docs" / "examples"
EXAMPLE = EXAMPLES / "json_robot.py"
SENSOR = EXAMPLES / "sensor_robot.py"


class Daemon:
    """``switchboard-robot`` in a ROS graph of its own."""

    lacks: frozenset[str] = frozenset()
    graph_grows = True

    def __init__(self, folder: Path, name: str, port: int) -> None:
        self._environment = ros_environment(free_domain())
        node = [sys.executable, str(HERE / "fixture_node.py")]
        self._node = Process(node, folder, "node", self._environment)
        self._state = folder / "state"
        enroll = [str(BIN / "switchboard-robot"), "enroll", "--relay", f"127.0.0.1:{port}", "--robot", name]
        enroll += ["--code", ENROLMENT_CODE, "--state", str(self._state)]
        self._daemon = Process(enroll, folder, "enroll", self._environment)
        self._folder = folder

    def run(self) -> None:
        """Starts it, once it is enrolled."""
        self._daemon.popen.wait(PATIENCE_TO_DIAL)
        self._node.wait_to_say("READY")
        run = [str(BIN / "switchboard-robot"), "run", "--state", str(self._state)]
        self._daemon = Process(run, self._folder, "daemon", self._environment)

    def stop(self) -> None:
        self._daemon.stop()
        self._node.stop()


class JsonRobot:
    """The example of a robot that speaks JSON only."""

    program = EXAMPLE
    graph_grows = False
    lacks = frozenset(
        (
            *(
                "test_publish",
                "test_large_sample",
                "test_kept_samples",
                "test_get_type",
                "test_get_interfaces",
            ),
            *("test_offer_service", "test_offer_action", "test_goal", "test_cancel"),
            *("test_old_goal_that_moves", "test_old_goal_that_moves_nothing"),
            "test_goal_sent_before_the_resume",
        )
    )
    """Cases about what it does not offer; with ``--listen`` a robot finds that out by itself."""

    def __init__(self, folder: Path, name: str, port: int) -> None:
        command = [sys.executable, str(self.program), "127.0.0.1", str(port), name, ENROLMENT_CODE]
        command.append(str(folder / "robot.json"))
        self._process = Process(command, folder, self.program.stem)

    def run(self) -> None:
        """It connects by itself."""

    def stop(self) -> None:
        self._process.stop()


class SensorRobot(JsonRobot):
    """The example of a robot that only measures."""

    program = SENSOR
    lacks = JsonRobot.lacks | frozenset(
        (
            *("test_two_channels", "test_call", "test_old_call_that_moves_nothing", "test_get_interfaces"),
            *("test_motion_is_known", "test_fresh_commands", "test_stops_when_commands_cease"),
            *("test_zero_is_repeated", "test_old_commands", "test_old_commands_do_not_keep_it_moving"),
            *("test_commands_of_the_future", "test_no_number", "test_nonsense_for_a_command"),
            *("test_unadvertise_stops", "test_cut_channel_stops", "test_other_samples_are_no_commands"),
            *("test_cut_control_stops", "test_only_the_holder", "test_another_holder", "test_same_holder"),
            "test_samples_are_no_commands",
            *(
                "test_stop",
                "test_stop_outlives_the_link",
                "test_resume_moves_nothing",
                "test_zero_is_a_release",
                "test_sent_before_the_resume",
                "test_stall_is_no_silence",
                "test_sent_before_control_was_lost",
            ),
            *("test_suppress", "test_suppression_ends_in_time"),
        )
    )


ROBOTS: dict[str, type[Daemon] | type[JsonRobot]] = {
    "daemon": Daemon,
    "json_robot": JsonRobot,
    "sensor_robot": SensorRobot,
}
