"""An unmodified roslibpy user that offers a service and sends goals. Prints its results as JSON.

Arguments: websocket URL, access token, the service it offers, an action, an action whose goals are to be
cancelled.
"""

import json
import sys
import threading

import roslibpy

url, token, service_name, action_name, endless_name = sys.argv[1:]
ros = roslibpy.Ros(host=url, headers={"Authorization": f"Bearer {token}"})
ros.run(timeout=20)
seen = {"feedback": []}

called = threading.Event()


def add(request, response):
    seen["request"] = dict(request)
    response["sum"] = request["a"] + request["b"]
    called.set()
    return True


service = roslibpy.Service(ros, service_name, "example_interfaces/AddTwoInts")
service.advertise(add)
print("offered", flush=True)
seen["called"] = called.wait(30)


def pursue(name, meanwhile):
    client = roslibpy.ActionClient(ros, name, "example_interfaces/action/Fibonacci")
    ends = []

    def feedback(message):
        seen["feedback"].append(message["sequence"])
        meanwhile(client, goal_id)

    goal_id = client.send_goal(roslibpy.Goal({"order": 5}), ends.append, feedback, ends.append)
    client.wait_goal(goal_id, 30)
    return {"status": ends[0]["status"].value, "values": ends[0]["values"]}


seen["result"] = pursue(action_name, lambda client, goal: None)
cancelled = []


def cancel_once(client, goal):
    if not cancelled:
        cancelled.append(goal)
        client.cancel_goal(goal)


seen["cancelled"] = pursue(endless_name, cancel_once)
service.unadvertise()
print(json.dumps(seen), flush=True)
ros.terminate()
