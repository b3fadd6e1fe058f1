"""A consumer of the Web of Things with wotpy: reads, observes, invokes, queries, cancels.

It does not write: wotpy 0.18 sends no credentials then. Nor does it fill in variables of addresses; this
program does. Prints its results as JSON. Arguments: address of the relay, access token, name of the robot.
"""

from __future__ import annotations

import asyncio
import json
import sys
import urllib.request
from typing import Any

from wotpy.protocols.http.client import HTTPClient
from wotpy.wot.consumed.thing import ConsumedThing
from wotpy.wot.td import ThingDescription


class OneClient:
    """The part of a servient that a consumed Thing needs."""

    def __init__(self, client: HTTPClient) -> None:
        self._client = client

    def select_client(self, description: ThingDescription, name: str) -> HTTPClient:
        return self._client


def consume(text: str, token: str) -> ConsumedThing:
    description, client = ThingDescription(text), HTTPClient()
    client.set_security(json.loads(text)["securityDefinitions"]["token"], {"token": token})
    return ConsumedThing(servient=OneClient(client), td=description)


async def observed(thing: ConsumedThing, name: str, count: int) -> list[Any]:
    done = asyncio.get_running_loop().create_future()
    values: list[Any] = []

    def receive(event: Any) -> None:
        values.append(event.data.value["value"])
        if len(values) == count and not done.done():
            done.set_result(None)

    def fail(error: Exception) -> None:
        if not done.done():
            done.set_exception(error)

    subscription = thing.on_property_change(name).subscribe(on_next=receive, on_error=fail)
    await done
    subscription.dispose()
    return values[:count]


async def ended(thing: ConsumedThing) -> dict[str, Any]:
    while True:
        status: dict[str, Any] = await thing.read_property("goal-status")
        if status["ended"] is not None:
            return status
        await asyncio.sleep(0.05)


def description_of(base: str, token: str, robot: str) -> str:
    address = f"{base}/api/v1/robots/{robot}/td?typed=true"
    request = urllib.request.Request(address, headers={"Authorization": f"Bearer {token}"})
    with urllib.request.urlopen(request) as answer:
        return str(answer.read().decode())


async def main(text: str, token: str) -> dict[str, Any]:
    thing = consume(text, token)
    seen: dict[str, Any] = {"odom": sorted((await thing.read_property("odom"))["value"])}
    seen["observed"] = await observed(thing, "conformance/counter", 3)
    seen["inverted"] = (await thing.invoke_action("conformance/invert", {"args": {"data": True}}))["values"]
    for name, order in (("finished", 5), ("cancelled", 1000)):
        begun = await thing.invoke_action(
            "conformance/fibonacci", {"goal": {"order": order}, "poll_timeout": 100}
        )
        of_goal = consume(text.replace("{id}", begun["id"]), token)
        if name == "cancelled":
            await of_goal.invoke_action("cancel-goal")
        status = await ended(of_goal)
        seen[name] = [status["state"], status["result"]]
    return seen


described = description_of(*sys.argv[1:])
print(json.dumps(asyncio.run(asyncio.wait_for(main(described, sys.argv[2]), 100))))
