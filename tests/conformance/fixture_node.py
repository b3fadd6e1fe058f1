"""The robot's side of the conformance suite: a ROS 2 node with topics, services and an action.

Start it on the robot whose rosbridge server is to be checked, with ROS 2 sourced: ``python fixture_node.py``.
It uses packages that every ROS 2 has; with ``example_interfaces`` it also offers an action.

Everything is under ``/conformance``. The suite does the rest by the service ``/conformance/do`` (its type,
strings in and strings out, is borrowed from ``rcl_interfaces/srv/ListParameters``): ``prefixes`` is a command
with its words, for example ``["listen", "/chatter", "std_msgs/msg/String", "reliable"]``, and
``result.names`` the answer, or ``["error", why]``.
"""

from __future__ import annotations

import array
import contextlib
import importlib
import json
import queue
import signal
import threading
import time
import traceback
from collections.abc import Callable
from typing import Any

import rclpy
from geometry_msgs.msg import Twist
from rcl_interfaces.msg import ParameterDescriptor
from rcl_interfaces.srv import ListParameters
from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Int64, String, UInt8MultiArray
from std_srvs.srv import Empty, SetBool, Trigger

try:
    from example_interfaces.action import Fibonacci
    from example_interfaces.srv import AddTwoInts
except ImportError:
    Fibonacci = AddTwoInts = None

VERSION = 2
COUNTER_SECONDS = 0.02
LARGE = 1_000_000
SLOW_SECONDS = 1.0
STEP_SECONDS = 0.05
PATIENCE = 10.0
"""Seconds a command waits for what it is about, until ``patience`` says otherwise."""

SETTLE = 1.0
PROFILES = {
    "reliable": QoSProfile(depth=100),
    "best_effort": QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT),
    "latched": QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
}


class Pursuer(ActionClient):
    """An action client that may be used in any thread.

    In rclpy (7.1) an answer that another executor thread takes before the request has been stored is dropped
    ("Ignoring unexpected goal response"), and the goal never continues.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self._asking = threading.Lock()
        super().__init__(*arguments, **options)

    def send_goal_async(self, *arguments: Any, **options: Any) -> Any:
        with self._asking:
            return super().send_goal_async(*arguments, **options)

    def _get_result_async(self, goal: Any) -> Any:
        with self._asking:
            return super()._get_result_async(goal)

    def _cancel_goal_async(self, goal: Any) -> Any:
        with self._asking:
            return super()._cancel_goal_async(goal)

    async def execute(self, taken: Any) -> None:
        with self._asking:
            pass  # now every request that can have an answer is stored
        await super().execute(taken)


def load(name: str) -> Any:
    """The class of ``std_msgs/msg/String``."""
    package, kind, type_name = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), type_name)


def to_plain(value: Any) -> Any:
    """A message as dicts, lists and numbers."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: to_plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, (str, bool, int, float)):
        return value
    if isinstance(value, (list, tuple, bytes, array.array)) or hasattr(value, "tolist"):
        return [to_plain(each) for each in list(value)]
    return value


def fill(message: Any, values: dict[str, Any]) -> Any:
    """Sets fields of a message from a dict."""
    for name, value in values.items():
        if isinstance(value, dict):
            fill(getattr(message, name), value)
        else:
            setattr(message, name, value)
    return message


def wait_for(condition: Callable[[], Any], seconds: float) -> Any:
    """Polls until a value is true, and returns it; after the timeout, the last value."""
    until = time.monotonic() + seconds
    while not (found := condition()) and time.monotonic() < until:
        time.sleep(0.01)
    return found


class Fixture(Node):
    """See the module's docstring."""

    def __init__(self) -> None:
        super().__init__("fixture", namespace="/conformance")
        self._group = ReentrantCallbackGroup()
        self._ends: dict[tuple[str, str], Any] = {}
        self._heard: dict[str, list[Any]] = {}
        self.leaving: queue.SimpleQueue[ActionClient] = queue.SimpleQueue()
        """Action clients to be destroyed by the thread that spins."""
        self._began = time.monotonic()
        self.cancelled = 0
        self.patience = PATIENCE
        for name, value in (("text", "hello"), ("number", 7), ("ratio", 0.5), ("truths", [True, False])):
            self.declare_parameter(f"conformance.{name}", value, ParameterDescriptor(dynamic_typing=True))
        self._offer()
        if Fibonacci is not None:
            self._offer_examples()

    def _offer(self) -> None:
        about = {"version": VERSION, "example_interfaces": Fibonacci is not None}
        for topic, text in (("about", json.dumps(about)), ("latched", "still here")):
            publisher = self.create_publisher(String, f"/conformance/{topic}", PROFILES["latched"])
            publisher.publish(String(data=text))
        large = self.create_publisher(UInt8MultiArray, "/conformance/large", PROFILES["latched"])
        large.publish(UInt8MultiArray(data=array.array("B", bytes(each % 251 for each in range(LARGE)))))
        self._counter = self.create_publisher(Int64, "/conformance/counter", PROFILES["reliable"])
        self.create_timer(COUNTER_SECONDS, self._count, callback_group=self._group)
        self._echo = self.create_publisher(String, "/conformance/echo/out", PROFILES["reliable"])
        self.create_subscription(String, "/conformance/echo/in", self._echo.publish, PROFILES["reliable"])
        # A topic that moves the robot and its report: the convention of docs/guides/robots.md for checking a
        # robot's motion.
        heard = self.create_publisher(Twist, "/conformance/cmd_vel/heard", PROFILES["latched"])
        self.create_subscription(Twist, "/conformance/cmd_vel", heard.publish, PROFILES["reliable"])
        for type_, name, function in (
            (ListParameters, "do", self._do),
            (Trigger, "beep", self._beep),
            (SetBool, "invert", self._invert),
            (Trigger, "slow", self._slow),
            (Empty, "nothing", lambda _, response: response),
        ):
            self.create_service(type_, f"/conformance/{name}", function, callback_group=self._group)

    def _offer_examples(self) -> None:
        add = "/conformance/add_two_ints"
        self.create_service(AddTwoInts, add, self._add, callback_group=self._group)
        self._server = ActionServer(
            self,
            Fibonacci,
            "/conformance/fibonacci",
            self._fibonacci,
            goal_callback=lambda goal: GoalResponse.REJECT if goal.order > 1000 else GoalResponse.ACCEPT,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            callback_group=self._group,
        )

    # --- permanent endpoints ---

    def _count(self) -> None:
        self._counter.publish(Int64(data=int((time.monotonic() - self._began) * 1000)))

    def _invert(self, request: Any, response: Any) -> Any:
        response.success = not request.data
        response.message = "inverted"
        return response

    def _beep(self, request: Any, response: Any) -> Any:
        response.success = True
        response.message = "beep"
        return response

    def _slow(self, request: Any, response: Any) -> Any:
        time.sleep(SLOW_SECONDS)
        response.success = True
        response.message = "at last"
        return response

    def _add(self, request: Any, response: Any) -> Any:
        response.sum = request.a + request.b
        return response

    def _fibonacci(self, goal: Any) -> Any:
        """A step every 50 ms; below 0 it is aborted, above 1000 it was not accepted."""
        sequence = [0, 1]
        result = Fibonacci.Result()
        for step in range(1, goal.request.order):
            if goal.is_cancel_requested:
                self.cancelled += 1
                goal.canceled()
                result.sequence = sequence
                return result
            sequence.append(sequence[step] + sequence[step - 1] if step < 40 else 0)
            goal.publish_feedback(Fibonacci.Feedback(sequence=sequence))
            time.sleep(STEP_SECONDS)
        if goal.request.order < 0:
            goal.abort()
        else:
            goal.succeed()
        result.sequence = sequence
        return result

    # --- commands ---

    def _do(self, request: Any, response: Any) -> Any:
        command, *words = request.prefixes
        try:
            response.result.names = [str(each) for each in getattr(self, f"do_{command}")(*words)]
        except Exception as error:
            response.result.names = ["error", f"{command}: {type(error).__name__}: {error}"]
        return response

    def do_patience(self, seconds: str) -> list[str]:
        """Sets the timeout of commands."""
        self.patience = float(seconds)
        return []

    def _wait(self, condition: Callable[[], Any]) -> Any:
        return wait_for(condition, self.patience)

    def do_publisher(self, topic: str, type_name: str, profile: str) -> list[str]:
        """Makes a topic."""
        self._ends["publisher", topic] = self.create_publisher(load(type_name), topic, PROFILES[profile])
        return []

    def do_publish(self, topic: str, *texts: str) -> list[str]:
        """Publishes messages, given as JSON, as soon as there is a subscriber.

        A server that subscribed before it knew the topic may use best effort at first, and miss messages
        meanwhile.
        """
        publisher = self._ends["publisher", topic]
        if self._wait(publisher.get_subscription_count) and self._reliable(publisher):
            wait_for(lambda: any(map(self._reliable, self.get_subscriptions_info_by_topic(topic))), SETTLE)
        for text in texts:
            publisher.publish(fill(publisher.msg_type(), json.loads(text)))
        return [str(publisher.get_subscription_count())]

    @staticmethod
    def _reliable(end: Any) -> bool:
        return bool(end.qos_profile.reliability == ReliabilityPolicy.RELIABLE)

    def do_latch(self, topic: str, text: str) -> list[str]:
        """Publishes at once, for later subscribers."""
        publisher = self._ends["publisher", topic]
        publisher.publish(fill(publisher.msg_type(), json.loads(text)))
        return []

    def do_subscribers(self, topic: str, count: str) -> list[str]:
        """Waits until one of the node's publishers has this many subscriptions; returns their number."""
        publisher = self._ends["publisher", topic]
        self._wait(lambda: publisher.get_subscription_count() == int(count))
        return [str(publisher.get_subscription_count())]

    def do_listen(self, topic: str, type_name: str, profile: str) -> list[str]:
        """Records a topic."""
        self._heard[topic] = heard = []
        subscription = self.create_subscription(
            load(type_name), topic, heard.append, PROFILES[profile], callback_group=self._group
        )
        self._ends["subscription", topic] = subscription
        return []

    def do_heard(self, topic: str, count: str, seconds: str = "10") -> list[str]:
        """Waits for this many messages; returns all, as JSON."""
        heard = self._heard[topic]
        wait_for(lambda: len(heard) >= int(count), float(seconds))
        return [json.dumps(to_plain(each)) for each in list(heard)]

    def do_end(self, kind: str, topic: str) -> list[str]:
        """Removes a ``publisher`` or a ``subscription``."""
        getattr(self, f"destroy_{kind}")(self._ends.pop((kind, topic)))
        return []

    def do_declare(self, name: str, text: str) -> list[str]:
        """Declares a parameter, with this value (JSON) if it is new."""
        if not self.has_parameter(name):
            self.declare_parameter(name, json.loads(text), ParameterDescriptor(dynamic_typing=True))
        return []

    def do_publishers(self, topic: str, count: str) -> list[str]:
        """Waits until a topic has this many publishers; returns their properties, as JSON."""
        self._wait(lambda: self.count_publishers(topic) == int(count))
        return [
            json.dumps(
                {
                    "type": each.topic_type,
                    "reliability": each.qos_profile.reliability.name.lower(),
                    "durability": each.qos_profile.durability.name.lower(),
                    "deadline": each.qos_profile.deadline.nanoseconds / 1e9,
                    "lifespan": each.qos_profile.lifespan.nanoseconds / 1e9,
                }
            )
            for each in self.get_publishers_info_by_topic(topic)
        ]

    def do_call(self, service: str, type_name: str, text: str, seconds: str = "10") -> list[str]:
        """Calls a service of another node; returns the response as JSON, or ``["absent"]``, ``["silence"]``."""
        type_ = load(type_name)
        client = self.create_client(type_, service, callback_group=self._group)
        try:
            if not client.wait_for_service(float(seconds)):
                return ["absent"]
            done = threading.Event()
            future = client.call_async(fill(type_.Request(), json.loads(text)))
            future.add_done_callback(lambda _: done.set())
            return [json.dumps(to_plain(future.result()))] if done.wait(float(seconds)) else ["silence"]
        finally:
            self.destroy_client(client)

    def do_offered(self, name: str, wanted: str) -> list[str]:
        """Waits until a service is (``1``) or isn't (``0``) in the graph; returns whether it is."""

        def offered() -> bool:
            return name in dict(self.get_service_names_and_types())

        self._wait(lambda: offered() == bool(int(wanted)))
        return [str(int(offered()))]

    def do_goal(self, action: str, type_name: str, text: str, cancel: str = "0") -> list[str]:
        """Sends a goal to an action of another node, cancelled after the first feedback if ``cancel`` is 1;
        returns a JSON of ``accepted``, ``status``, ``feedback`` and ``result``. Feedback can be ``heard``
        meanwhile.
        """
        type_ = load(type_name)
        feedback = self._heard[action] = []
        client = Pursuer(self, type_, action, callback_group=self._group)
        try:
            if not client.wait_for_server(self.patience):
                return ["absent"]
            goal = fill(type_.Goal(), json.loads(text))
            asked = client.send_goal_async(
                goal, feedback_callback=lambda each: feedback.append(each.feedback)
            )
            handle = self._settled(asked)
            if not handle.accepted:
                return [json.dumps({"accepted": False})]
            ended = handle.get_result_async()
            if int(cancel):
                self._wait(lambda: feedback)
                self._settled(handle.cancel_goal_async())
            answer = self._settled(ended)
            reported = {"accepted": True, "status": answer.status, "result": to_plain(answer.result)}
            return [json.dumps({**reported, "feedback": to_plain(feedback)})]
        finally:
            self.leaving.put(client)

    def do_cancelled(self, count: str) -> list[str]:
        """Waits until this many of the node's own goals were cancelled; returns their number."""
        self._wait(lambda: self.cancelled >= int(count))
        return [str(self.cancelled)]

    def _settled(self, future: Any) -> Any:
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        if not done.wait(self.patience):
            raise TimeoutError("no answer came")
        return future.result()


def main() -> None:
    """Runs until a signal arrives."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Fixture()
    executor = MultiThreadedExecutor(num_threads=12)
    executor.add_node(node)
    spinning = threading.Thread(target=_spin, args=(executor, node.leaving), daemon=True)
    spinning.start()
    print("READY", flush=True)
    signal.sigwait({signal.SIGINT, signal.SIGTERM})
    executor.shutdown(timeout_sec=2)
    rclpy.try_shutdown()
    spinning.join(2)


def _spin(executor: MultiThreadedExecutor, leaving: queue.SimpleQueue[ActionClient]) -> None:
    with contextlib.suppress(ExternalShutdownException):
        while rclpy.ok():
            try:
                executor.spin_once()
            except ExternalShutdownException:
                raise
            except Exception:  # an error of one callback, such as a client that left before its answer
                traceback.print_exc()
            # Only by this thread: it checks all action clients when it begins to wait (rclpy 7.1).
            with contextlib.suppress(queue.Empty):
                leaving.get_nowait().destroy()


if __name__ == "__main__":
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    main()
