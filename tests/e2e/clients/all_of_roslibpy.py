"""All features of roslibpy for ROS 2, once each, against the conformance suite's fixture node.

Arguments: websocket URL, access token. Prints the results as JSON.
"""

import enum
import json
import queue
import sys

import roslibpy

FIBONACCI = "example_interfaces/action/Fibonacci"
SECONDS = 20
url, token = sys.argv[1:]
ros = roslibpy.Ros(host=url, headers={"Authorization": f"Bearer {token}"})
ros.run(timeout=SECONDS)
seen = {}


def service(name, type_name):
    return roslibpy.Service(ros, name, type_name)


def fixture(*words):
    """Sends a command to the fixture node."""
    do = service("/conformance/do", "rcl_interfaces/srv/ListParameters")
    return do.call(roslibpy.ServiceRequest({"prefixes": list(words)}), timeout=SECONDS)["result"]["names"]


def first(topic, count=1):
    """The first messages of a topic."""
    heard = queue.Queue()
    topic.subscribe(heard.put)
    found = [dict(heard.get(timeout=SECONDS)) for _ in range(count)]
    topic.unsubscribe()
    return found


# --- rosapi ---
seen["topics"] = ros.get_topics()
seen["topics_for_type"] = ros.get_topics_for_type("std_msgs/msg/Int64")
seen["topic_type"] = ros.get_topic_type("/conformance/counter")
seen["services"] = ros.get_services()
seen["services_for_type"] = ros.get_services_for_type("std_srvs/srv/SetBool")
seen["service_type"] = ros.get_service_type("/conformance/invert")
seen["request"] = ros.get_service_request_details("std_srvs/srv/SetBool")["typedefs"][0]["fieldnames"]
seen["response"] = ros.get_service_response_details("std_srvs/srv/SetBool")["typedefs"][0]["fieldnames"]
seen["message"] = ros.get_message_details("geometry_msgs/msg/Twist")["typedefs"][0]["fieldnames"]
seen["nodes"] = ros.get_nodes()
seen["node"] = ros.get_node_details("/conformance/fixture")
answers = queue.Queue()
ros.get_action_servers(answers.put, answers.put)
seen["action_servers"] = answers.get(timeout=SECONDS)
seen["params"] = ros.get_params()
seen["time"] = ros.get_time()

# --- topics ---
LATCHED = ("/conformance/latched", "std_msgs/msg/String")
seen["latched"] = first(roslibpy.Topic(ros, *LATCHED))
counter = roslibpy.Topic(ros, "/conformance/counter", "std_msgs/msg/Int64", throttle_rate=200, queue_length=2)
seen["throttled"] = [each["data"] for each in first(counter, 4)]
heard = queue.Queue()
out = roslibpy.Topic(ros, "/conformance/echo/out", "std_msgs/msg/String")
out.subscribe(heard.put)
into = roslibpy.Topic(ros, "/conformance/echo/in", "std_msgs/msg/String", queue_size=5, latch=True)
into.advertise()
while heard.empty():
    into.publish(roslibpy.Message({"data": "said by roslibpy"}))
    try:
        seen["echoed"] = dict(heard.get(timeout=0.2))
        break
    except queue.Empty:
        continue
into.unadvertise()
out.unsubscribe()

# --- services, in both directions ---
invert = service("/conformance/invert", "std_srvs/srv/SetBool")
seen["inverted"] = dict(invert.call(roslibpy.ServiceRequest({"data": True}), timeout=SECONDS))
invert.call(roslibpy.ServiceRequest({"data": False}), answers.put, answers.put)
seen["inverted later"] = dict(answers.get(timeout=SECONDS))
try:
    service("/nowhere", "std_srvs/srv/Trigger").call(roslibpy.ServiceRequest(), timeout=SECONDS)
except Exception as error:
    seen["absent"] = str(error)


def answer(request, response):
    response["success"] = not request["data"]
    response["message"] = "from roslibpy"
    return True


offered = service("/roslibpy/invert", "std_srvs/srv/SetBool")
offered.advertise(answer)
seen["called from graph"] = fixture("call", "/roslibpy/invert", "std_srvs/srv/SetBool", '{"data": true}')
offered.unadvertise()
seen["gone"] = fixture("offered", "/roslibpy/invert", "0")

# --- actions ---
action = roslibpy.ActionClient(ros, "/conformance/fibonacci", FIBONACCI)
results, feedback, failures = queue.Queue(), queue.Queue(), queue.Queue()
goal = action.send_goal(roslibpy.Goal({"order": 5}), results.put, feedback.put, failures.put)
action.wait_goal(goal, timeout=SECONDS)
seen["result"] = dict(results.get(timeout=SECONDS))
seen["feedback"] = feedback.qsize()
begun = queue.Queue()
goal = action.send_goal(roslibpy.Goal({"order": 900}), results.put, begun.put, failures.put)
begun.get(timeout=SECONDS)
action.cancel_goal(goal)
action.wait_goal(goal, timeout=SECONDS)
seen["cancelled"] = dict(results.get(timeout=SECONDS))

# --- parameters ---
number = roslibpy.Param(ros, "/conformance/fixture:conformance.number")
seen["before"] = number.get(timeout=SECONDS)
number.set(9, timeout=SECONDS)
seen["after"] = number.get(timeout=SECONDS)
number.set(7, timeout=SECONDS)
ros.set_param("/conformance/fixture:conformance.text", "changed")
seen["text"] = ros.get_param("/conformance/fixture:conformance.text")
ros.set_param("/conformance/fixture:conformance.text", "hello")

ros.terminate()
print(json.dumps(seen, default=lambda each: each.value if isinstance(each, enum.Enum) else dict(each)))
