"""A stand-in for rosbridge_server, built the way it is built, for one topic. Started by ``endtoend``, as a process.

Arguments: port, topic. An rclpy node on a SingleThreadedExecutor subscribes parsed; the message becomes values once
(``bench/rosbridge_way.py``), and JSON by ujson for each client, sent by Tornado. The executor has a thread of its
own that blocks; the server it stands for turns it a thousand times a second from Tornado's loop, which costs more.
"""

from __future__ import annotations

import contextlib
import sys
import threading
from typing import Any

import rclpy
import tornado.ioloop
import tornado.web
import tornado.websocket
import ujson
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import LaserScan

from bench import rosbridge_way


class Bridge:
    """The topic and those who want it."""

    def __init__(self, topic: str, loop: tornado.ioloop.IOLoop) -> None:
        self.topic = topic
        self.clients: set[Client] = set()
        self._loop = loop

    def heard(self, message: Any) -> None:
        """A message, in the executor's thread."""
        values = rosbridge_way.values(message)
        for client in list(self.clients):
            text = ujson.dumps({"op": "publish", "topic": self.topic, "msg": values})
            self._loop.add_callback(client.pass_on, text)


class Client(tornado.websocket.WebSocketHandler):
    """One websocket."""

    def initialize(self, bridge: Bridge) -> None:
        """What it belongs to."""
        self.bridge = bridge

    def open(self, *_: str, **__: str) -> None:
        """It gets everything from now on."""
        self.bridge.clients.add(self)

    def on_message(self, message: str | bytes) -> None:
        """Whatever it asks for, it has already."""

    def on_close(self) -> None:
        """It has left."""
        self.bridge.clients.discard(self)

    def pass_on(self, text: str) -> None:
        """In the loop's thread."""
        if self.ws_connection is not None:
            self.write_message(text)


def main() -> None:
    """Serve until SIGTERM."""
    port, topic = int(sys.argv[1]), sys.argv[2]
    loop = tornado.ioloop.IOLoop.current()
    bridge = Bridge(topic, loop)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("rosbridge_like")
    node.create_subscription(LaserScan, topic, bridge.heard, 10)
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def spin() -> None:
        with contextlib.suppress(ExternalShutdownException):
            executor.spin()

    tornado.web.Application([("/.*", Client, {"bridge": bridge})]).listen(port, "127.0.0.1")
    threading.Thread(target=spin, daemon=True).start()
    print("READY", flush=True)
    loop.start()


if __name__ == "__main__":
    main()
