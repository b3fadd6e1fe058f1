"""A program that shows an element of a Role, by ICPI: once a second, from start to stop. See docs/guides/icpi.md.

SWITCHBOARD_TOKEN=… python icpi_display.py ws://127.0.0.1:9090/icpi display Display-Show-Rover SPEED_NOW
"""

import json
import os
import re
import sys
import time
from urllib.parse import unquote

from websockets.sync.client import connect

URL, NAME, ROLE, ELEMENT = sys.argv[1:]
SHOWN = "shown"


def write(dest, id, function, *args, ak=0):
    """A message; '%', '!' and '(' are escaped in values."""
    escaped = (re.sub("[%!(]", lambda found: f"%{ord(found[0]):02X}", each) for each in args)
    values = "".join(f"({number}){each}" for number, each in enumerate(escaped))
    return f"{dest}!sn!{NAME}!id!{id}!ak!{ak}!fx!{function}!ar!{values}!br!0"


def read(text):
    """Sender, id, function and arguments of a message."""
    parts = text.split("!")
    return parts[2], parts[4], parts[8], [unquote(each) for each in re.split(r"\(\d+\)", parts[10])[1:]]


on, due = False, 0.0
with connect(URL, additional_headers={"Authorization": f"Bearer {os.environ['SWITCHBOARD_TOKEN']}"}) as relay:
    relay.send(write("relay", 1, "register", NAME, "[]", json.dumps(["start", "stop"]), ak=1))
    while True:
        if on and time.monotonic() >= due:
            due = time.monotonic() + 1
            relay.send(write(ROLE, SHOWN, "get", ELEMENT, ak=1))
        try:
            sender, id, function, args = read(relay.recv(timeout=0.2))
        except TimeoutError:
            continue
        if function in ("start", "stop"):
            on = function == "start"
            relay.send(write(sender, id, "reply", "ok", ""))
        elif function == "reply":
            print(ELEMENT if id == SHOWN else "registered", *args, flush=True)
