"""A program with a port and a function, by ICPI: a lamp. docs/guides/icpi.md explains it.

SWITCHBOARD_TOKEN=… python icpi_lamp.py ws://127.0.0.1:9090/icpi lamp
"""

import json
import os
import re
import sys
from urllib.parse import unquote

from websockets.sync.client import connect

URL, NAME = sys.argv[1:]
lamp = {"power": False}


def write(dest, id, function, *args, ak=0):
    """A message; '%', '!' and '(' are escaped in values."""
    escaped = (re.sub("[%!(]", lambda found: f"%{ord(found[0]):02X}", each) for each in args)
    values = "".join(f"({number}){each}" for number, each in enumerate(escaped))
    return f"{dest}!sn!{NAME}!id!{id}!ak!{ak}!fx!{function}!ar!{values}!br!0"


def read(text):
    """Sender, id, function, arguments of a message, and whether it needs a reply."""
    parts = text.split("!")
    args = [unquote(each) for each in re.split(r"\(\d+\)", parts[10])[1:]]
    return parts[2], parts[4], parts[8], args, parts[6] == "1"


def power(value):
    lamp["power"] = value
    relay.send(write("relay", "", "publish", "power", json.dumps(value)))
    print(f"the lamp is {'on' if value else 'off'}", flush=True)
    return json.dumps(value)


def carry_out(function, args):
    """The value of the reply."""
    if function == "get":
        return json.dumps(lamp[args[0]])
    if function == "set" and args[0] == "power":
        return power(json.loads(args[1]) is True)
    if function == "toggle":
        return power(not lamp["power"])
    if function in ("start", "stop"):
        return power(function == "start")
    raise ValueError(f"there is no {function}")


with connect(URL, additional_headers={"Authorization": f"Bearer {os.environ['SWITCHBOARD_TOKEN']}"}) as relay:
    functions = json.dumps(["toggle", "start", "stop"])
    relay.send(write("relay", 1, "register", NAME, json.dumps(["power"]), functions, ak=1))
    for text in relay:
        sender, id, function, args, asks = read(text)
        if function == "reply":
            # Of the relay, to our own requests.
            print(*args, flush=True)
        elif asks:
            try:
                relay.send(write(sender, id, "reply", "ok", carry_out(function, args)))
            except (ValueError, LookupError) as error:
                relay.send(write(sender, id, "reply", "error", str(error)))
        else:
            print(f"{sender} says {function} {args}", flush=True)
