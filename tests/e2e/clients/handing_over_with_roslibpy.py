"""Two unmodified roslibpy users share a robot: one drives, the other requests control and gets it. Prints
JSON.

Arguments: websocket URL, access token of the first, of the second.
"""

import json
import sys
import threading
import time

import roslibpy

url, *tokens = sys.argv[1:]


class Peer:
    """A connection, its messages about control, and its joystick."""

    def __init__(self, token):
        self.ros = roslibpy.Ros(host=url, headers={"Authorization": f"Bearer {token}"})
        self.ros.run(timeout=20)
        self.heard = []
        self.changed = threading.Condition()
        self.control = roslibpy.Topic(self.ros, "/relay/control", "switchboard_msgs/Control")
        self.control.subscribe(self.on_control)
        self.command = roslibpy.Topic(self.ros, "/cmd_vel", "geometry_msgs/Twist")

    def on_control(self, message):
        with self.changed:
            self.heard.append(message)
            self.changed.notify_all()

    def until(self, holds):
        with self.changed:
            return self.changed.wait_for(lambda: self.heard and holds(self.heard[-1]), 20)

    def call(self, service, **fields):
        asked = roslibpy.Service(self.ros, service, "switchboard_msgs/Order")
        return dict(asked.call(roslibpy.ServiceRequest(fields), timeout=20))

    def drive(self, seconds, speed):
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self.command.publish(roslibpy.Message({"linear": {"x": speed}}))
            time.sleep(0.05)


first, second = (Peer(token) for token in tokens)
seen = {"free": first.until(lambda reported: reported["state"] == "free")}
first.drive(1.0, 0.2)
seen["held"] = first.until(lambda reported: reported["holder"] and reported["holder"]["you"])
seen["asked"] = second.call("/relay/take_control", why="my turn")
seen["requested"] = first.until(
    lambda reported: reported["request"] and reported["request"]["why"] == "my turn"
)
seen["granted"] = first.call("/relay/grant_control")
seen["handed over"] = second.until(lambda reported: reported["holder"] and reported["holder"]["you"])
marked = time.monotonic_ns()
first.drive(0.5, 0.2)
second.drive(1.0, -0.2)
seen["since"] = marked
seen["released"] = second.call("/relay/release_control")
for peer in (first, second):
    peer.ros.close()
print(json.dumps(seen))
first.ros.terminate()
