"""An unmodified roslibpy user that stays: prints ODOMETRY and the number of disconnections, when odometry
arrives (again).

Arguments: websocket URL, access token.
"""

import sys
import threading

import roslibpy

url, token = sys.argv[1:]
ros = roslibpy.Ros(host=url, headers={"Authorization": f"Bearer {token}"})
cuts = 0
reported = -1


def on_close(_):
    global cuts
    cuts += 1


def on_odom(_):
    global reported
    if reported < cuts:
        reported = cuts
        print(f"ODOMETRY {cuts}", flush=True)


ros.on("close", on_close)
ros.run(timeout=20)
odom = roslibpy.Topic(ros, "/odom", "nav_msgs/Odometry")
odom.subscribe(on_odom)
threading.Event().wait()
