"""Goals of those who come by HTTP, on a real database, with a robot in memory."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.defer import Deferred

from relay_db import queries
from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound, Refused, SwitchboardError, Unavailable
from relay_server.access import Principal
from relay_server.common.freshness_tokens import FreshnessTokenExpired, FreshnessTokenRequired
from relay_server.control.audit import Actor
from relay_server.control.commands import NotDone
from relay_server.http.negotiation import ConversionPool
from relay_server.http_sessions.pool import LINGER_SECONDS, SessionPool
from relay_server.resources import goals as limits
from relay_server.resources import goals as module
from relay_server.resources.goals import NEXT, GoalRequest, GoalService, GoalState, HttpGoal
from relay_server.resources.page import PageQuery
from relay_server.resources.service import RequestOrigin, RobotResourceService
from tests.relay_server.channel.goal_ends import FEEDBACK, RESULT
from tests.relay_server.edges.robot_ends import until
from tests.relay_server.front_desk import HERE, Desk
from tests.relay_server.memory import FIBONACCI, MOTION, TWIST

COUNT, SPIN = "/count", "/spin"
THREE = GoalRequest(b'{"order":3}')


class House:
    """Ann, who gives goals to rover."""

    def __init__(self, front: Desk) -> None:
        self.front = front
        self.world = front.world
        self.guests = SessionPool(self.world.clock, front.desk, self.world.now_ns)
        # Not started: nothing of a goal takes long.
        threads = ConversionPool(reactor)
        resources = RobotResourceService(
            self.world.clock, self.guests, threads, self.world.now_ns, front.wall
        )
        self.desk = GoalService(self.world.clock, self.guests, resources, front.wall)
        self.ann = RequestOrigin(Principal(0, "", "", False, 0, None), "rover", HERE)

    async def begin(self) -> None:
        """The robot is there, and has told of its types; it was asked for one goal by then."""
        self.world.robot_comes()
        policy = link.MotionPolicy(types=[TWIST], actions=[SPIN])
        self.world.robot.description = msgspec.structs.replace(MOTION, motion=policy)
        for name in (COUNT, SPIN):
            self.world.robot.graph.actions[name] = link.Service(types=[FIBONACCI], providers=["/counter"])
        self.ann = self.ann._replace(principal=await self.front.by_token(self.front.ann))
        giving = self.giving()
        await until(lambda: bool(list(self.front.desk)))
        self.world.robot_joins()
        self.world.define()
        goal = await giving
        self.finishes()
        assert goal.state is GoalState.SUCCEEDED

    def giving(
        self, name: str = COUNT, ask: GoalRequest = THREE, moment: int | None = None
    ) -> Deferred[HttpGoal]:
        """Ann gives a goal; fires when that is done."""
        return Deferred.fromCoroutine(self.desk.give(self.ann, name, ask, moment))

    def sent(self) -> list[link.SendActionGoal]:
        """What the robot was sent, and has not ended."""
        return self.world.link.all(link.SendActionGoal)

    def cancelled(self) -> list[str]:
        """Goals that the robot was told to cancel."""
        return [each.id for each in self.world.link.all(link.CancelActionGoal)]

    def finishes(self, status: int = 4, **more: Any) -> None:
        """The robot is done with all it was sent."""
        for goal in self.world.link.take(link.SendActionGoal):
            body = {"result": True, "cdr": self.world.cdr(RESULT, sequence=[0, 1])} | more
            self.world.channel.message(link.ActionResult(id=goal.id, status=status, **body))

    def comes_so_far(self, *sequence: int) -> None:
        """The robot tells so of all it was sent."""
        for goal in self.sent():
            body = self.world.cdr(FEEDBACK, sequence=list(sequence))
            self.world.channel.message(link.ActionFeedback(id=goal.id, cdr=body))

    async def status(self, goal: HttpGoal, asker: RequestOrigin | None = None) -> Any:
        """What is told of a goal, without a look at it."""
        return json.loads((await self.desk.told(asker or self.ann, goal)).body)

    def passes(self, seconds: float) -> None:
        """Time, in steps."""
        self.world.clock.pump([0.25] * round(seconds / 0.25))


async def house_of(front: Desk) -> House:
    """A house where all is ready."""
    house = House(front)
    await house.begin()
    return house


async def refusal(work: Any) -> SwitchboardError:
    """How something is refused."""
    with pytest.raises(SwitchboardError) as caught:
        await work
    return caught.value


def test_what_is_over_stays_so() -> None:
    """Every state but two is an end."""
    assert {state for state, following in NEXT.items() if following} == {
        GoalState.ACTIVE,
        GoalState.CANCELLING,
    }
    assert set(NEXT) == set(GoalState)


@pytest_twisted.ensureDeferred
async def test_a_goal_is_told_from_its_beginning_to_its_end(front: Desk) -> None:
    """How far it has come, and what came of it; it can be read for some minutes."""
    house = await house_of(front)
    goal = await house.giving()
    began = house.front.wall()
    status = await house.status(goal)
    assert status == {
        "id": goal.id, "action": COUNT, "type": FIBONACCI, "state": "active", "reason": None,
        "begun": began, "ended": None, "feedback": None, "result": None,
    }  # fmt: skip
    house.comes_so_far(0, 1)
    assert (await house.status(goal))["feedback"] == {"sequence": [0, 1]}
    house.passes(1)
    house.finishes()
    status = await house.status(goal)
    assert (status["state"], status["result"], status["ended"]) == (
        "succeeded", {"sequence": [0, 1]}, began + 1
    )  # fmt: skip
    house.passes(module.KEPT_SECONDS - 1)
    assert house.desk.find(house.ann, goal.id) is goal
    house.passes(1)
    with pytest.raises(NotFound):
        house.desk.find(house.ann, goal.id)
    assert not house.desk._book._of and not house.desk._book._ended


@pytest_twisted.ensureDeferred
async def test_nobody_who_vanishes_leaves_a_goal_behind(front: Desk) -> None:
    """When nobody has looked at it for so long it is cancelled, and then its connection ends."""
    house = await house_of(front)
    goal = await house.giving(ask=THREE._replace(unwatched=3.0))
    house.passes(2.75)
    assert not house.cancelled()
    house.passes(0.25)
    assert len(house.cancelled()) == 1
    assert (await house.status(goal))["state"] == "cancelling"
    house.passes(LINGER_SECONDS)
    assert not list(front.desk)
    status = await house.status(goal)
    assert (status["state"], status["reason"]) == ("canceled", "nobody has looked at it for 3 s")


@pytest_twisted.ensureDeferred
async def test_who_looks_keeps_a_goal(front: Desk) -> None:
    """Each look anew, and one that lasts as long as it does; the connection is kept for it."""
    house = await house_of(front)
    goal = await house.giving(ask=THREE._replace(unwatched=3.0))
    for _ in range(5):
        house.passes(2.5)
        assert await house.desk.state(house.ann, goal.id, 0, frozenset())
    told = await house.desk.told(house.ann, goal)
    waiting = Deferred.fromCoroutine(house.desk.state(house.ann, goal.id, 60, frozenset({told.etag})))
    house.passes(2 * LINGER_SECONDS)
    assert not house.cancelled() and not waiting.called
    house.comes_so_far(0, 1)
    further = await waiting
    assert not further.known and further.etag != told.etag
    house.passes(3)
    assert len(house.cancelled()) == 1


@pytest_twisted.ensureDeferred
async def test_who_waits_in_vain_is_told_that_nothing_has_changed(front: Desk) -> None:
    """When his time is over; at once, when nothing more can come."""
    house = await house_of(front)
    goal = await house.giving()
    told = await house.desk.told(house.ann, goal)
    waiting = Deferred.fromCoroutine(house.desk.state(house.ann, goal.id, 2, frozenset({told.etag})))
    house.passes(1.75)
    assert not waiting.called
    house.passes(0.25)
    assert (await waiting).known
    house.finishes()
    last = await house.desk.told(house.ann, goal)
    assert (await house.desk.state(house.ann, goal.id, 60, frozenset({last.etag}))).known
    assert not goal._waiting


@pytest_twisted.ensureDeferred
async def test_the_end_is_awaited(front: Desk) -> None:
    """As long as is wanted; feedback is none."""
    house = await house_of(front)
    goal = await house.giving()
    waiting = Deferred.fromCoroutine(house.desk.awaited(house.ann, goal.id, 20))
    house.comes_so_far(0)
    house.passes(15)
    assert not waiting.called and not house.cancelled()
    house.finishes()
    told = await waiting
    assert told is not None and told.over
    assert await house.desk.awaited(house.ann, "another", 20) is None


@pytest_twisted.ensureDeferred
async def test_a_goal_is_cancelled_by_who_gave_it(front: Desk) -> None:
    """Its end still comes; one that is over is not cancelled."""
    house = await house_of(front)
    goal = await house.giving()
    assert house.desk.cancel(house.ann, goal.id) is goal
    assert house.desk.cancel(house.ann, goal.id) is goal
    assert (len(house.cancelled()), goal.state) == (1, GoalState.CANCELLING)
    house.finishes(status=5)
    status = await house.status(goal)
    assert (status["state"], status["reason"]) == ("canceled", "it was cancelled by who gave it")
    assert house.desk.cancel(house.ann, goal.id) is None
    with pytest.raises(NotFound):
        house.desk.cancel(house.ann, "another")


@pytest.mark.parametrize(
    ("end", "told"),
    [
        ({"status": 5}, ("canceled", "it was cancelled on the robot", [0, 1])),
        ({"status": 6}, ("aborted", "the robot gave it up", [0, 1])),
        ({"status": 6, "result": False, "cdr": None, "reason": "stuck"}, ("aborted", "stuck", None)),
        ({"status": 0, "result": False, "cdr": None, "reason": "not now"}, ("refused", "not now", None)),
    ],
)
@pytest_twisted.ensureDeferred
async def test_how_a_goal_ended_is_said_in_words(
    front: Desk, end: dict[str, Any], told: tuple[str, str, list[int] | None]
) -> None:
    """Those of the robot, where it has some."""
    house = await house_of(front)
    goal = await house.giving()
    house.finishes(**end)
    status = await house.status(goal)
    result = None if status["result"] is None else status["result"]["sequence"]
    assert (status["state"], status["reason"], result) == told


@pytest_twisted.ensureDeferred
async def test_what_moves_the_robot_is_dated_and_takes_control(front: Desk) -> None:
    """As commands are; who loses control is told who has it."""
    house = await house_of(front)
    now = house.world.now_ns()
    assert isinstance(await refusal(house.giving(SPIN)), FreshnessTokenRequired)
    assert isinstance(await refusal(house.giving(SPIN, moment=now - 600_000_000)), FreshnessTokenExpired)
    assert not house.sent()
    goal = await house.giving(SPIN, moment=now)
    lease = house.world.desks.of(house.world.robot).lease
    assert lease.holder is not None and lease.holder.client.name == "ann"
    await house.world.desks.of(house.world.robot).stopping.stop(
        Actor("bob", "user:bob", 2, HERE), "in the way"
    )
    house.finishes(status=5)
    assert (await house.status(goal))["reason"] == "robot rover was stopped by bob: in the way"


@pytest_twisted.ensureDeferred
async def test_control_that_is_lost_is_said_to_be(front: Desk) -> None:
    """Where that has ended the goal."""
    house = await house_of(front)
    goal = await house.giving(SPIN, moment=house.world.now_ns())
    desk = house.world.desks.of(house.world.robot)
    assert desk.lease.holder is not None
    desk.release(desk.lease.holder.client, "", Actor("olga", "user:olga", 3, HERE))
    house.finishes(status=5)
    assert (await house.status(goal))["reason"] == "control of robot rover was lost or given back"


@pytest_twisted.ensureDeferred
async def test_a_relay_that_goes_down_says_so(front: Desk) -> None:
    """To who waits, and the goal is cancelled."""
    house = await house_of(front)
    goal = await house.giving()
    waiting = Deferred.fromCoroutine(house.desk.awaited(house.ann, goal.id, 60))
    front.desk.say_goodbye("the relay is going down")
    assert len(house.cancelled()) == 1
    await waiting
    assert (goal.state, goal.reason) == (GoalState.CANCELED, "the relay is going down")


@pytest_twisted.ensureDeferred
async def test_a_robot_that_is_lost_has_ended_its_goals(front: Desk) -> None:
    """In words; one that is offline is given none."""
    house = await house_of(front)
    goal = await house.giving()
    house.world.robot_goes()
    house.world.channel.link_lost(house.world.link)
    assert goal.state is GoalState.ABORTED and "lost its connection" in (goal.reason or "")
    assert isinstance(await refusal(house.giving()), Unavailable)


@pytest_twisted.ensureDeferred
async def test_a_right_that_is_withdrawn_ends_what_is_shown(front: Desk) -> None:
    """How it ended is told still; how far it had come, and what came of it, no more."""
    house = await house_of(front)
    done, going = await house.giving(), None
    house.finishes()
    going = await house.giving()
    house.comes_so_far(0, 1)
    with front.store.database.begin() as session:
        queries.grant_right(session, front.rover.id, "viewer", user_id=front.ann.id)
    await front.access.refresh()
    assert len(house.cancelled()) == 1
    status = await house.status(going)
    assert (status["state"], status["feedback"]) == ("canceled", None)
    assert "call on /count" in status["reason"]
    assert (await house.status(done))["result"] is None
    with front.store.database.begin() as session:
        queries.revoke_right(session, front.rover.id, user_id=front.ann.id)
    await front.access.refresh()
    assert (await house.status(done))["state"] == "succeeded"
    assert (await house.desk.members(house.ann, PageQuery()))["goals"]


@pytest_twisted.ensureDeferred
async def test_goals_are_their_owners(front: Desk) -> None:
    """Another user, and another scope, has none of them; another token for the same has all."""
    house = await house_of(front)
    goal = await house.giving()
    with front.store.database.begin() as session:
        bob = queries.add_user(session, "bob", None)
        queries.grant_right(session, front.rover.id, "owner", user_id=bob.id)
    narrower = await front.by_token(front.ann, "operator")
    others = [house.ann._replace(principal=each) for each in (await front.by_token(bob), narrower)]
    for other in (*others, house.ann._replace(robot="hidden")):
        with pytest.raises(NotFound):
            house.desk.find(other, goal.id)
        with pytest.raises(NotFound):
            house.desk.cancel(other, goal.id)
    for other in others:
        assert (await house.desk.members(other, PageQuery()))["goals"] == []
    hidden = house.ann._replace(robot="hidden")
    assert isinstance(await refusal(house.desk.members(hidden, PageQuery())), NotFound)
    same, _ = await front.logged_in()
    assert house.desk.find(house.ann._replace(principal=same), goal.id) is goal
    assert len(goal.id) >= 40


@pytest_twisted.ensureDeferred
async def test_goals_are_listed_in_the_order_in_which_they_were_given(front: Desk) -> None:
    """Page by page, those of an action alone, without feedback and results."""
    house = await house_of(front)
    given = []
    for _ in range(3):
        house.passes(0.25)
        given.append((await house.giving()).id)
    house.passes(0.25)
    await house.giving(SPIN, moment=house.world.now_ns())
    page = await house.desk.members(house.ann, PageQuery(name="/c*", limit=3))
    assert [each["id"] for each in page["goals"]][1:] == given[:2]
    assert "feedback" not in page["goals"][0]
    rest = await house.desk.members(house.ann, PageQuery(name="/c*", after=page["next"]))
    assert [each["id"] for each in rest["goals"]] == given[2:] and rest["next"] == ""
    assert (await house.desk.members(house.ann, PageQuery(type="other/action/Type")))["goals"] == []


@pytest_twisted.ensureDeferred
async def test_what_can_not_begin_is_refused_in_words(front: Desk) -> None:
    """And leaves nothing, neither a goal nor a connection that is kept."""
    house = await house_of(front)
    wrong = await refusal(house.giving(ask=GoalRequest(b'{"order":"five"}')))
    assert isinstance(wrong, NotDone) and "order" in str(wrong)
    assert isinstance(await refusal(house.giving("/nowhere")), NotFound)
    assert isinstance(await refusal(house.giving("no name!")), Invalid)
    assert isinstance(await refusal(house.giving(ask=THREE._replace(type="no type"))), Invalid)
    with front.store.database.begin() as session:
        queries.grant_right(session, front.rover.id, "viewer", user_id=front.ann.id)
    await front.access.refresh()
    assert isinstance(await refusal(house.giving()), Refused)
    assert len((await house.desk.members(house.ann, PageQuery()))["goals"]) == 1
    house.passes(LINGER_SECONDS)
    assert not list(front.desk)


@pytest_twisted.ensureDeferred
async def test_one_user_has_so_many(front: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    """Under way; and of those that are over the newest are kept, by number and by size."""
    house = await house_of(front)
    monkeypatch.setattr(module, "UNDER_WAY", 2)
    monkeypatch.setattr(module, "KEPT", 2)
    goals = [await house.giving(), await house.giving()]
    assert isinstance(await refusal(house.giving()), Unavailable)
    house.finishes()
    goals.append(await house.giving())
    house.finishes()
    kept = {each["id"] for each in (await house.desk.members(house.ann, PageQuery()))["goals"]}
    assert kept == {each.id for each in goals[1:]}
    monkeypatch.setattr(module, "KEPT_BYTES", 1)
    last = await house.giving()
    house.finishes()
    (only,) = (await house.desk.members(house.ann, PageQuery()))["goals"]
    assert only["id"] == last.id


@pytest_twisted.ensureDeferred
async def test_what_is_too_long_is_not_kept(front: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    """And said to be."""
    monkeypatch.setattr(limits, "FEEDBACK_BYTES", 20)
    monkeypatch.setattr(limits, "RESULT_BYTES", 10)
    house = await house_of(front)
    goal = await house.giving()
    house.comes_so_far(*range(9))
    status = await house.status(goal)
    assert status["feedback"] is None and "no more than 20 are kept" in status["reason"]
    house.comes_so_far(1)
    assert (await house.status(goal))["reason"] is None
    house.finishes()
    status = await house.status(goal)
    assert (status["state"], status["result"]) == ("succeeded", None)
    assert "no more than 10 are kept" in status["reason"]
