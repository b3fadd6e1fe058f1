"""Twenty clients race for control of one robot: whether two ever had it, by the robot's own record, and how fast.

In each round all ask at once; who gets it drives, the others try to all the same, then it is given back. A command's
speed is its client's own, its turning speed the number of the round, so the simulator's record tells of each command
that was carried out whose it was, and when it was given.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from websockets.asyncio.client import ClientConnection, connect

from bench.relay import Relay
from bench.report import Options, Row
from tests.worlds.processes import running
from tests.worlds.robot_process import Robot

TOPIC = "/cmd_vel"
TWIST = "geometry_msgs/msg/Twist"
PACE = 0.25
"""Seconds between two rounds or hand-overs: nobody may ask for control more than five times a second."""

COMMANDS = 3
"""Each gives in a round."""
TURN = 1e-4
"""Radians per second, for the number of a round."""


class Racer:
    """One connection.

    :param speed: metres per second, its own
    """

    def __init__(self, url: str, token: str, speed: float) -> None:
        self.speed = speed
        self._url, self._token = url, token
        self._numbers = itertools.count()
        self._answers: dict[str, asyncio.Future[dict[str, Any]]] = {}
        self._connection: ClientConnection
        self._reader: asyncio.Task[None]
        self.controls = asyncio.Event()
        """Set while ``/relay/control`` says that this connection holds it."""

    async def open(self) -> None:
        """Connect, and hear who has control."""
        headers = {"Authorization": f"Bearer {self._token}"}
        self._connection = await connect(self._url, additional_headers=headers, compression=None)
        self._reader = asyncio.create_task(self._read())
        await self._send(op="advertise", topic=TOPIC, type=TWIST)
        await self._send(op="subscribe", topic="/relay/control")

    async def close(self) -> None:
        """Leave."""
        await self._connection.close()
        await self._reader

    async def call(self, service: str) -> bool:
        """Whether the relay has done it."""
        name = str(next(self._numbers))
        waiting = self._answers[name] = asyncio.get_running_loop().create_future()
        await self._send(op="call_service", service=service, id=name, args={"why": "bench"})
        async with asyncio.timeout(20):
            answer = await waiting
        return bool(answer["result"] and answer["values"]["success"])

    async def drive(self, number: int) -> None:
        """One command of a round."""
        await self._publish(self.speed, number * TURN)

    async def let_go(self) -> None:
        """A command of zero."""
        await self._publish(0.0, 0.0)

    async def _publish(self, speed: float, turn: float) -> None:
        await self._send(op="publish", topic=TOPIC, msg={"linear": {"x": speed}, "angular": {"z": turn}})

    async def _send(self, **message: Any) -> None:
        await self._connection.send(json.dumps(message))

    async def _read(self) -> None:
        async for text in self._connection:
            message = json.loads(text)
            if message["op"] == "service_response":
                self._answers.pop(message["id"]).set_result(message)
            elif message["op"] == "publish":
                holder = message["msg"]["holder"]
                if holder is not None and holder["you"]:
                    self.controls.set()
                else:
                    self.controls.clear()


class Race:
    """All rounds, and what was seen in them."""

    def __init__(self, robot: Robot, racers: list[Racer]) -> None:
        self._robot = robot
        self._racers = racers
        self.winners: list[float] = []
        """Their speeds, by round."""
        self.several = 0
        """Rounds in which not exactly one client was told that it has control."""
        self.asking: list[float] = []
        """From asking to having it, milliseconds."""

    async def begin(self) -> None:
        """Drive until the robot moves: the first commands wait for its guard to be ready."""
        first = self._racers[0]
        await first.call("/relay/take_control")
        async with asyncio.timeout(30):
            while not any(each["v"] for each in self._robot.events("command")):
                await first.drive(0)
                await asyncio.sleep(0.05)
        await first.let_go()
        await first.call("/relay/release_control")

    async def round(self) -> None:
        """All ask, one drives, the others try to."""
        await asyncio.sleep(PACE)
        number, asked = len(self.winners), time.monotonic_ns()
        said = await asyncio.gather(*(self._ask(each) for each in self._racers))
        winners = [(racer, at) for racer, at in zip(self._racers, said, strict=True) if at]
        self.several += len(winners) != 1
        self.winners.append(winners[0][0].speed if winners else 0.0)
        for _ in range(COMMANDS):
            await asyncio.gather(*(each.drive(number) for each in self._racers))
        await asyncio.gather(*(each.let_go() for each in self._racers))
        for winner, at in winners:
            self.asking.append((at - asked) / 1e6)
            await winner.call("/relay/release_control")

    async def _ask(self, racer: Racer) -> int:
        won = await racer.call("/relay/take_control")
        return time.monotonic_ns() if won else 0

    async def handed_over(self) -> float:
        """One hands control to another; milliseconds from its word to the first command of the other."""
        giver, taker = self._racers[:2]
        granted, said = False, 0
        while not granted:
            # On a machine that stands still for seconds the giver loses control, and begins again.
            await asyncio.sleep(PACE)
            await giver.call("/relay/take_control")
            await giver.drive(0)
            await taker.call("/relay/take_control")
            # People wait, too. The controller is notified at once, but at most ten times a second.
            await asyncio.sleep(PACE)
            said = time.monotonic_ns()
            granted = await self._granted(giver, taker)
        moved = await self._first(taker, said)
        await taker.let_go()
        await taker.call("/relay/release_control")
        return (moved - said) / 1e6

    async def _granted(self, giver: Racer, taker: Racer) -> bool:
        """Whether control was handed over; true as soon as the taker has it."""
        granting = asyncio.create_task(giver.call("/relay/grant_control"))
        taking = asyncio.create_task(taker.controls.wait())
        await asyncio.wait((granting, taking), return_when=asyncio.FIRST_COMPLETED)
        has_it = taking.done()
        taking.cancel()
        return await granting and (has_it or await taker.call("/relay/take_control"))

    async def _first(self, racer: Racer, since: int) -> int:
        """Have a client drive; when its first command was carried out."""
        async with asyncio.timeout(20):
            while True:
                await racer.drive(0)
                for _ in range(10):
                    commands = self._robot.events("command", since)
                    at = next((int(each["t"]) for each in commands if each["v"] == racer.speed), 0)
                    if at:
                        return at
                    await asyncio.sleep(0.005)

    def wrong(self, commands: list[dict[str, Any]]) -> int:
        """Commands that were carried out though their client did not have control in that round."""
        return sum(self.winners[round(each["w"] / TURN)] != each["v"] for each in commands)


async def _race(relay: Relay, robot: Robot, tokens: list[str], rounds: int, handovers: int) -> list[Row]:
    racers = [Racer(relay.url("rover"), token, round(0.05 + 0.005 * n, 3)) for n, token in enumerate(tokens)]
    async with contextlib.AsyncExitStack() as stack:
        for each in racers:
            await each.open()
            stack.push_async_callback(each.close)
        race = Race(robot, racers)
        await race.begin()
        begun = time.monotonic_ns()
        for _ in range(rounds):
            await race.round()
        commands = [each for each in robot.events("command", begun) if each["v"]]
        times = [await race.handed_over() for _ in range(handovers)]
    return _rows(race, commands, times, len(racers))


def _rows(race: Race, commands: list[dict[str, Any]], times: list[float], clients: int) -> list[Row]:
    asked = f"asked by {clients} at once → has control"
    given = "handed over → the other's first command is carried out"
    return [
        Row(
            "control",
            f"{clients} clients, {len(race.winners)} rounds: rounds without exactly one holder",
            "rounds",
            race.several,
            bar=0,
        ),
        Row(
            "control",
            "commands carried out of who did not have control",
            "commands",
            race.wrong(commands),
            bar=0,
            note=f"by the robot's own record, of {len(commands)} commands it carried out",
        ),
        Row("control", f"{asked}, median", "ms", statistics.median(race.asking)),
        Row("control", f"{asked}, worst", "ms", max(race.asking)),
        Row("control", f"{given}, median", "ms", statistics.median(times)),
        Row("control", f"{given}, worst of {len(times)}", "ms", max(times)),
    ]


def run(options: Options) -> list[Row]:
    """The race, then hand-overs."""
    clients = int(options.pick(4, 20))
    rounds, handovers = int(options.pick(5, 1000)), int(options.pick(2, 100))
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        relay = Relay(Path(folder))
        with running(relay):
            robot = Robot(relay, "rover")
            with running(robot):
                tokens = []
                for number in range(clients):
                    tokens.append(relay.user(f"racer{number}"))
                    relay.cli("right", "grant", f"racer{number}", "rover", "operator")
                return asyncio.run(_race(relay, robot, tokens, options.runs or rounds, handovers))
