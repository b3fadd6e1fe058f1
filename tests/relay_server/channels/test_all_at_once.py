"""Random events at the same time: each call and each goal is answered once, and no state is left."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.rights import Grant, Level, Rules
from tests.worlds.relay import ADD, FIBONACCI, MemoryLink, Person, World

ALL = Rules([Grant(Level.OPERATOR, (), ())])
NONE = Rules([Grant(Level.OPERATOR, (), ("provide:*", "call:/fib"))])


class RandomRun:
    """One robot, a client that offers services, two callers and the graph, with all requests and answers."""

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

    # --- actions ---

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

    def graph_goal(self) -> None:
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

    def graph_cancel(self) -> None:
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
                link.Failed(request="send_action_goal", reference=asked.id, reason="no"),
            ])  # fmt: skip
        elif isinstance(asked, link.CallService):
            message = link.ServiceResponse(id=asked.id, result=False, reason="no")
        elif isinstance(asked, link.AdvertiseService):
            message = self.dice.choice([
                link.AdvertisedService(service="/add", type=ADD),
                link.Failed(request="advertise_service", reference="/add", reason="no"),
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
            person.context.permit.rules = rules
            person.context.permit.on_change()

    def time_passes(self) -> None:
        self.world.wait(self.dice.choice([0.5, 3, 12]), self.provider, *self.askers)

    # --- recorded messages ---

    @property
    def open(self) -> bool:
        return self.world.channel.link_state.link is not None

    def play(self, moves: int) -> None:
        choices: list[Callable[[], None]] = [
            self.offer, self.offer, self.withdraw, self.client_asks, self.client_asks, self.client_asks,
            self.client_cancels, self.graph_goal, self.graph_goal, self.graph_cancel, self.provider_answers,
            self.provider_answers, self.provider_answers, self.robot_answers, self.robot_answers,
            self.robot_defines, self.robot_defines, self.link_breaks, self.robot_leaves, self.rights_change,
            self.time_passes,
        ]  # fmt: skip
        for _ in range(moves):
            self.dice.choice(choices)()
            self.look()

    def look(self) -> None:
        """Reads all messages that clients were sent."""
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


def people(run: RandomRun) -> list[Person]:
    """All clients."""
    return [run.provider, *run.askers]


@pytest.mark.parametrize("seed", range(20))
def test_everyone_is_answered_once(seed: int) -> None:
    """The answer comes from a client, the robot, a timeout, or because the peer has left. Every place is
    released.
    """
    run = RandomRun(seed)
    run.play(300)
    assert all(count == 1 for count in run.graph_answered().values())
    assert set(run.graph_answered()) <= set(run.graph_asked)
    run.provider.session.end()
    run.look()
    here = {key for key in run.graph_asked if key[0] == len(run.links)}
    waiting_for_a_type = {each for each in here if each not in run.graph_answered()}
    assert not waiting_for_a_type or run.world.link.all(link.GetType)
    run.world.robot_goes()
    run.world.wait(60, *run.askers)
    run.look()
    assert run.answered == run.sent
    channel = run.world.channel
    assert not channel.goals._pending._by_client
    assert not channel.goals._on_robot
    assert not channel.client_calls._graph_calls
    assert not channel.services._offered
    assert not channel.actions._offered
    assert channel.link_state.names_in_use == 0
    for person in run.askers:
        assert not person.session.goals._goals
        assert not person.session.service_calls._calls
