"""Everything at random at the same time: each call and each goal is answered once, and nothing is left behind."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.rights import Grant, Level, Rules
from tests.relay_server.memory import ADD, FIBONACCI, MemoryLink, Person, World

ALL = Rules([Grant(Level.OPERATOR, (), ())])
NONE = Rules([Grant(Level.OPERATOR, (), ("provide:*", "call:/fib"))])


class Game:
    """One robot, one client that offers, two that ask, and the graph; what was asked and what was answered."""

    def __init__(self, seed: int) -> None:
        self.dice = random.Random(seed)
        self.world = World()
        self.world.robot_comes()
        self.provider = self.world.person()
        self.askers = [self.world.person(), self.world.person()]
        self.links: list[MemoryLink] = [self.world.robot_joins()]
        self.world.robot.graph.actions["/count"] = link.Service(types=[FIBONACCI], providers=["/counter"])
        self.asked: list[dict[str, Any]] = []
        self.sent: list[Counter[Any]] = [Counter() for _ in self.askers]
        self.answered: list[Counter[Any]] = [Counter() for _ in self.askers]
        self.graph_asked: Counter[tuple[int, str]] = Counter()
        self.at_robot: list[link.Message] = []
        self.next = 0

    # --- moves ---

    def offer(self) -> None:
        self.provider.says("advertise_service", service="/add", type=ADD)
        self.provider.says("advertise_action", action="/fib", type=FIBONACCI)

    def withdraw(self) -> None:
        what = self.dice.choice(["service", "action"])
        self.provider.says(f"unadvertise_{what}", **{what: "/add" if what == "service" else "/fib"})

    def client_asks(self) -> None:
        who = self.dice.randrange(len(self.askers))
        self.next += 1
        self.sent[who][self.next] += 1
        if self.dice.random() < 0.5:
            timeout = self.dice.choice([1, 10, 50])
            self.askers[who].says(
                "call_service", service="/add", id=self.next, args={"a": 1}, timeout=timeout
            )
        else:
            action = self.dice.choice(["/fib", "/count", "/nothing"])
            self.askers[who].says("send_action_goal", action=action, id=self.next, args=[3], feedback=True)

    def client_cancels(self) -> None:
        who = self.dice.randrange(len(self.askers))
        self.askers[who].says("cancel_action_goal", action="/fib", id=self.dice.randint(1, self.next + 1))

    def graph_asks(self) -> None:
        if not self.open:
            return
        self.next += 1
        id = f"s{self.next}"
        self.graph_asked[len(self.links), id] += 1
        if self.dice.random() < 0.5:
            message: Any = link.CallService(
                id=id, service="/add", type=ADD, timeout=9, cdr="AAEAAA" + "A" * 22
            )
        else:
            message = link.SendActionGoal(
                id=id, action="/fib", type=FIBONACCI, feedback=True, cdr="AAEAAAMAAAA="
            )
        self.world.channel.message(message)

    def graph_cancels(self) -> None:
        if self.open:
            self.world.channel.message(link.CancelActionGoal(id=f"s{self.dice.randint(1, self.next + 1)}"))

    def provider_answers(self) -> None:
        if not self.asked:
            return
        ask = self.asked.pop(self.dice.randrange(len(self.asked)))
        good = self.dice.random() < 0.7
        if ask["op"] == "call_service":
            values = {"sum": 3} if good else {"sum": "three"}
            self.provider.says("service_response", service="/add", id=ask["id"], values=values)
        else:
            values = {"sequence": [1]} if good else {"sequence": "none"}
            self.provider.says("action_feedback", action="/fib", id=ask["id"], values=values)
            self.provider.says("action_result", action="/fib", id=ask["id"], values=values)
        if self.dice.random() < 0.2:
            self.asked.append(ask)

    def robot_answers(self) -> None:
        if not self.at_robot or not self.open:
            return
        asked = self.at_robot.pop(self.dice.randrange(len(self.at_robot)))
        message: Any = None
        if isinstance(asked, link.SendActionGoal):
            body = "AAEAAAEAAAABAAAA"
            self.world.channel.message(link.ActionFeedback(id=asked.id, cdr=body))
            message = self.dice.choice([
                link.ActionResult(id=asked.id, status=4, result=True, cdr=body),
                link.ActionResult(id=asked.id, status=6, result=False, reason="no"),
                link.Failed(what="send_action_goal", ref=asked.id, reason="no"),
            ])  # fmt: skip
        elif isinstance(asked, link.CallService):
            message = link.ServiceResponse(id=asked.id, result=False, reason="no")
        elif isinstance(asked, link.AdvertiseService):
            message = self.dice.choice([
                link.AdvertisedService(service="/add", type=ADD),
                link.Failed(what="advertise_service", ref="/add", reason="no"),
            ])  # fmt: skip
        elif isinstance(asked, link.AdvertiseAction):
            message = link.AdvertisedAction(action="/fib", type=FIBONACCI)
        if message is not None:
            self.world.channel.message(message)

    def robot_defines(self) -> None:
        if self.open:
            self.world.define()

    def link_breaks(self) -> None:
        if self.open and self.dice.random() < 0.3:
            self.world.channel.link_lost(self.world.link)
            self.at_robot.clear()
            self.world.wait(1, self.provider, *self.askers)
            self.links.append(self.world.robot_joins())

    def robot_leaves(self) -> None:
        if self.dice.random() < 0.2:
            self.world.robot_goes()
            self.at_robot.clear()
            self.look()
            self.world.robot_comes()
            self.world.robot.graph.actions["/count"] = link.Service(types=[FIBONACCI])
            self.links.append(self.world.robot_joins())

    def rights_change(self) -> None:
        person = self.dice.choice([self.provider, *self.askers])
        for rules in (NONE, ALL):
            person.session.permit.rules = rules
            person.session.permit.on_change()

    def time_passes(self) -> None:
        self.world.wait(self.dice.choice([0.5, 3, 12]), self.provider, *self.askers)

    # --- the board ---

    @property
    def open(self) -> bool:
        return self.world.channel.wire.link is not None

    def play(self, moves: int) -> None:
        choices: list[Callable[[], None]] = [
            self.offer, self.offer, self.withdraw, self.client_asks, self.client_asks, self.client_asks,
            self.client_cancels, self.graph_asks, self.graph_asks, self.graph_cancels, self.provider_answers,
            self.provider_answers, self.provider_answers, self.robot_answers, self.robot_answers,
            self.robot_defines, self.robot_defines, self.link_breaks, self.robot_leaves, self.rights_change,
            self.time_passes,
        ]  # fmt: skip
        for _ in range(moves):
            self.dice.choice(choices)()
            self.look()

    def look(self) -> None:
        """Take in what everybody was sent."""
        for message in self.provider.client.take():
            if message["op"] in ("call_service", "send_action_goal"):
                self.asked.append(message)
        for person, answered in zip(self.askers, self.answered, strict=True):
            for message in person.client.take():
                if message["op"] in ("service_response", "action_result"):
                    answered[message["id"]] += 1
                elif message["op"] == "action_feedback":
                    assert not answered[message["id"]], "feedback behind the result"
        known = (link.SendActionGoal, link.CallService, link.AdvertiseService, link.AdvertiseAction)
        for kind in known:
            self.at_robot += self.world.link.take(kind)

    def graph_answered(self) -> Counter[tuple[int, str]]:
        """Answers by link and id."""
        return Counter(
            (number, message.id)
            for number, each in enumerate(self.links, 1)
            for message in each.said
            if isinstance(message, (link.ServiceResponse, link.ActionResult))
        )


def people(game: Game) -> list[Person]:
    """All clients."""
    return [game.provider, *game.askers]


@pytest.mark.parametrize("seed", range(20))
def test_everyone_is_answered_once(seed: int) -> None:
    """By clients, by the robot, by time, or because somebody has gone; no place is lost."""
    game = Game(seed)
    game.play(300)
    assert all(count == 1 for count in game.graph_answered().values())
    assert set(game.graph_answered()) <= set(game.graph_asked)
    game.provider.session.end()
    game.look()
    here = {key for key in game.graph_asked if key[0] == len(game.links)}
    waiting_for_a_type = {each for each in here if each not in game.graph_answered()}
    assert not waiting_for_a_type or game.world.link.all(link.GetType)
    game.world.robot_goes()
    game.world.wait(60, *game.askers)
    game.look()
    assert game.answered == game.sent
    channel = game.world.channel
    assert not channel.goals._errands._of
    assert not channel.goals._at_robot
    assert not channel.served._graph_calls
    assert not channel.services._offers
    assert not channel.actions._offers
    assert channel.wire.names == 0
    for person in game.askers:
        assert not person.session.pursuing._goals
        assert not person.session.calling._calls
