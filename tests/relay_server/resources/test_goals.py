"""Action goals by HTTP, with a real database and a robot in memory."""

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
from relay_server.common.errors import NotDone
from relay_server.common.freshness_tokens import HEADER, FreshnessTokenExpired, FreshnessTokenRequired
from relay_server.control.actor import Actor
from relay_server.in_process_sessions.pool import LINGER_SECONDS, InProcessSessionPool, RobotCaller
from relay_server.resources import goals as limits
from relay_server.resources import goals as module
from relay_server.resources.goals import NEXT, GoalRequest, GoalService, GoalState, HttpGoal
from relay_server.resources.page import TypedPageQuery
from relay_server.resources.representations import ConversionPool
from relay_server.resources.service import RobotResourceService
from tests.worlds.goal_peers import FEEDBACK, RESULT
from tests.worlds.relay import FIBONACCI, MOTION, TWIST
from tests.worlds.robot_links import until
from tests.worlds.session_manager import HERE, SessionsWorld

COUNT, SPIN = "/count", "/spin"
THREE = GoalRequest(b'{"order":3}')


class GoalsWorld:
    """Ann, who sends goals to rover."""

    def __init__(self, front: SessionsWorld) -> None:
        self.front = front
        self.world = front.world
        self.pool = InProcessSessionPool(self.world.clock, front.service)
        # The pool is not started: nothing in these tests takes long.
        threads = ConversionPool(reactor)
        resources = RobotResourceService(self.world.clock, self.pool, threads, self.world.now_ns, front.wall)
        self.service = GoalService(self.world.clock, self.pool, resources, front.wall)
        self.ann = RobotCaller(Principal(0, "", "", False, 0, None), "rover", HERE)

    async def begin(self) -> None:
        """The robot is online with its definitions known; one goal was sent and has succeeded."""
        self.world.robot_comes()
        policy = link.MotionPolicy(types=[TWIST], actions=[SPIN])
        self.world.robot.description = msgspec.structs.replace(MOTION, motion=policy)
        for name in (COUNT, SPIN):
            self.world.robot.graph.actions[name] = link.Service(types=[FIBONACCI], providers=["/counter"])
        self.ann = self.ann._replace(principal=await self.front.by_token(self.front.ann))
        giving = self.giving()
        await until(lambda: bool(list(self.front.service)))
        self.world.robot_joins()
        self.world.define()
        goal = await giving
        self.finishes()
        assert goal.state is GoalState.SUCCEEDED

    def giving(
        self, name: str = COUNT, ask: GoalRequest = THREE, earliest_sent: int | None = None
    ) -> Deferred[HttpGoal]:
        """Ann sends a goal; fires when the request is done."""
        return Deferred.fromCoroutine(self.service.give(self.ann, name, ask, earliest_sent))

    def sent(self) -> list[link.SendActionGoal]:
        """Goals that the robot has received and not ended."""
        return self.world.link.all(link.SendActionGoal)

    def cancelled(self) -> list[str]:
        """Goals that the robot was asked to cancel."""
        return [each.id for each in self.world.link.all(link.CancelActionGoal)]

    def finishes(self, status: int = 4, **more: Any) -> None:
        """The robot ends all its goals."""
        for goal in self.world.link.take(link.SendActionGoal):
            body = {"result": True, "cdr": self.world.cdr(RESULT, sequence=[0, 1])} | more
            self.world.channel.message(link.ActionResult(id=goal.id, status=status, **body))

    def comes_so_far(self, *sequence: int) -> None:
        """The robot sends feedback for all its goals."""
        for goal in self.sent():
            body = self.world.cdr(FEEDBACK, sequence=list(sequence))
            self.world.channel.message(link.ActionFeedback(id=goal.id, cdr=body))

    async def status(self, goal: HttpGoal, caller: RobotCaller | None = None) -> Any:
        """A goal's status, which does not count as polling."""
        return json.loads((await self.service.status(caller or self.ann, goal)).body)

    def passes(self, seconds: float) -> None:
        """Lets time pass in steps."""
        self.world.clock.pump([0.25] * round(seconds / 0.25))


async def ready_world(front: SessionsWorld) -> GoalsWorld:
    """A world with a robot that is ready for goals."""
    scene = GoalsWorld(front)
    await scene.begin()
    return scene


async def refusal(work: Any) -> SwitchboardError:
    """The error of a refused request."""
    with pytest.raises(SwitchboardError) as caught:
        await work
    return caught.value


def test_ended_goal_stays_ended() -> None:
    """All states but two are final."""
    assert {state for state, following in NEXT.items() if following} == {
        GoalState.ACTIVE,
        GoalState.CANCELLING,
    }
    assert set(NEXT) == set(GoalState)


@pytest_twisted.ensureDeferred
async def test_a_goal_is_reported_from_its_start_to_its_end(front: SessionsWorld) -> None:
    """With feedback and result; it can be read for some minutes."""
    scene = await ready_world(front)
    goal = await scene.giving()
    began = scene.front.wall()
    status = await scene.status(goal)
    assert status == {
        "id": goal.id, "action": COUNT, "type": FIBONACCI, "state": "active", "reason": None,
        "begun": began, "ended": None, "feedback": None, "result": None,
    }  # fmt: skip
    scene.comes_so_far(0, 1)
    assert (await scene.status(goal))["feedback"] == {"sequence": [0, 1]}
    scene.passes(1)
    scene.finishes()
    status = await scene.status(goal)
    assert (status["state"], status["result"], status["ended"]) == (
        "succeeded", {"sequence": [0, 1]}, began + 1
    )  # fmt: skip
    scene.passes(module.KEPT_SECONDS - 1)
    assert scene.service.find(scene.ann, goal.id) is goal
    scene.passes(1)
    with pytest.raises(NotFound):
        scene.service.find(scene.ann, goal.id)
    assert not scene.service._store._of and not scene.service._store._ended


@pytest_twisted.ensureDeferred
async def test_gone_client_leaves_no_goal(front: SessionsWorld) -> None:
    """A goal that is not polled for some time is cancelled; then its connection ends."""
    scene = await ready_world(front)
    goal = await scene.giving(ask=THREE._replace(poll_timeout=3.0))
    scene.passes(2.75)
    assert not scene.cancelled()
    scene.passes(0.25)
    assert len(scene.cancelled()) == 1
    assert (await scene.status(goal))["state"] == "cancelling"
    scene.passes(LINGER_SECONDS)
    assert not list(front.service)
    status = await scene.status(goal)
    assert (status["state"], status["reason"]) == ("canceled", "its status was not requested for 3 s")


@pytest_twisted.ensureDeferred
async def test_polling_keeps_a_goal(front: SessionsWorld) -> None:
    """Each poll extends it, also during a long poll; the connection stays open meanwhile."""
    scene = await ready_world(front)
    goal = await scene.giving(ask=THREE._replace(poll_timeout=3.0))
    for _ in range(5):
        scene.passes(2.5)
        assert await scene.service.state(scene.ann, goal.id, 0, frozenset())
    reported = await scene.service.status(scene.ann, goal)
    waiting = Deferred.fromCoroutine(scene.service.state(scene.ann, goal.id, 60, frozenset({reported.etag})))
    scene.passes(2 * LINGER_SECONDS)
    assert not scene.cancelled() and not waiting.called
    scene.comes_so_far(0, 1)
    further = await waiting
    assert not further.known and further.etag != reported.etag
    scene.passes(3)
    assert len(scene.cancelled()) == 1


@pytest_twisted.ensureDeferred
async def test_wait_without_a_change_answers_not_modified(front: SessionsWorld) -> None:
    """At the end of the wait; at once if the goal has ended."""
    scene = await ready_world(front)
    goal = await scene.giving()
    reported = await scene.service.status(scene.ann, goal)
    waiting = Deferred.fromCoroutine(scene.service.state(scene.ann, goal.id, 2, frozenset({reported.etag})))
    scene.passes(1.75)
    assert not waiting.called
    scene.passes(0.25)
    assert (await waiting).known
    scene.finishes()
    last = await scene.service.status(scene.ann, goal)
    assert (await scene.service.state(scene.ann, goal.id, 60, frozenset({last.etag}))).known
    assert not goal._waiting


@pytest_twisted.ensureDeferred
async def test_the_end_is_awaited(front: SessionsWorld) -> None:
    """For the requested time; feedback does not end the wait."""
    scene = await ready_world(front)
    goal = await scene.giving()
    waiting = Deferred.fromCoroutine(scene.service.awaited(scene.ann, goal.id, 20))
    scene.comes_so_far(0)
    scene.passes(15)
    assert not waiting.called and not scene.cancelled()
    scene.finishes()
    reported = await waiting
    assert reported is not None and reported.over
    assert await scene.service.awaited(scene.ann, "another", 20) is None


@pytest_twisted.ensureDeferred
async def test_a_goal_is_cancelled_by_its_owner(front: SessionsWorld) -> None:
    """Its result still arrives; an ended goal is not cancelled."""
    scene = await ready_world(front)
    goal = await scene.giving()
    assert scene.service.cancel(scene.ann, goal.id) is goal
    assert scene.service.cancel(scene.ann, goal.id) is goal
    assert (len(scene.cancelled()), goal.state) == (1, GoalState.CANCELLING)
    scene.finishes(status=5)
    status = await scene.status(goal)
    assert (status["state"], status["reason"]) == ("canceled", "its owner cancelled it")
    assert scene.service.cancel(scene.ann, goal.id) is None
    with pytest.raises(NotFound):
        scene.service.cancel(scene.ann, "another")


@pytest.mark.parametrize(
    ("end", "reported"),
    [
        ({"status": 5}, ("canceled", "it was cancelled on the robot", [0, 1])),
        ({"status": 6}, ("aborted", "the robot aborted it", [0, 1])),
        ({"status": 6, "result": False, "cdr": None, "reason": "stuck"}, ("aborted", "stuck", None)),
        ({"status": 0, "result": False, "cdr": None, "reason": "not now"}, ("refused", "not now", None)),
    ],
)
@pytest_twisted.ensureDeferred
async def test_the_end_of_a_goal_is_explained(
    front: SessionsWorld, end: dict[str, Any], reported: tuple[str, str, list[int] | None]
) -> None:
    """With the robot's reason if there is one."""
    scene = await ready_world(front)
    goal = await scene.giving()
    scene.finishes(**end)
    status = await scene.status(goal)
    result = None if status["result"] is None else status["result"]["sequence"]
    assert (status["state"], status["reason"], result) == reported


@pytest_twisted.ensureDeferred
async def test_command_is_dated_and_takes_control(front: SessionsWorld) -> None:
    """The rules of commands apply; a user who loses control gets the new controller's name."""
    scene = await ready_world(front)
    now = scene.world.now_ns()
    assert isinstance(await refusal(scene.giving(SPIN)), FreshnessTokenRequired)
    expired = await refusal(scene.giving(SPIN, earliest_sent=now - 600_000_000))
    assert isinstance(expired, FreshnessTokenExpired) and HEADER in str(expired)
    assert not scene.sent()
    goal = await scene.giving(SPIN, earliest_sent=now)
    lease = scene.world.controllers.of(scene.world.robot).lease
    assert lease.holder is not None and lease.holder.client.name == "ann"
    await scene.world.controllers.of(scene.world.robot).stopping.stop(
        Actor("bob", "user:bob", 2, HERE), "in the way"
    )
    scene.finishes(status=5)
    assert (await scene.status(goal))["reason"] == "robot rover was stopped by bob: in the way"


@pytest_twisted.ensureDeferred
async def test_lost_control_is_reported(front: SessionsWorld) -> None:
    """If losing control ended the goal."""
    scene = await ready_world(front)
    goal = await scene.giving(SPIN, earliest_sent=scene.world.now_ns())
    backend = scene.world.controllers.of(scene.world.robot)
    assert backend.lease.holder is not None
    backend.release(backend.lease.holder.client, "", Actor("olga", "user:olga", 3, HERE))
    scene.finishes(status=5)
    assert (await scene.status(goal))["reason"] == "control of robot rover was lost or released"


@pytest_twisted.ensureDeferred
async def test_a_shutdown_is_reported_to_waiting_requests(front: SessionsWorld) -> None:
    """Waiting requests get it, and the goal is cancelled."""
    scene = await ready_world(front)
    goal = await scene.giving()
    waiting = Deferred.fromCoroutine(scene.service.awaited(scene.ann, goal.id, 60))
    front.service.shutdown("the relay is going down")
    assert len(scene.cancelled()) == 1
    await waiting
    assert (goal.state, goal.reason) == (GoalState.CANCELED, "the relay is going down")


@pytest_twisted.ensureDeferred
async def test_a_robot_that_is_lost_has_ended_its_goals(front: SessionsWorld) -> None:
    """With a reason; an offline robot accepts no goals."""
    scene = await ready_world(front)
    goal = await scene.giving()
    scene.world.robot_goes()
    scene.world.channel.link_lost(scene.world.link)
    assert goal.state is GoalState.ABORTED and "lost its connection" in (goal.reason or "")
    assert isinstance(await refusal(scene.giving()), Unavailable)


@pytest_twisted.ensureDeferred
async def test_a_right_that_is_withdrawn_ends_what_is_shown(front: SessionsWorld) -> None:
    """The state is still shown; feedback and result are not."""
    scene = await ready_world(front)
    done, going = await scene.giving(), None
    scene.finishes()
    going = await scene.giving()
    scene.comes_so_far(0, 1)
    with front.store.database.begin() as session:
        queries.grant_right(session, front.rover.id, "viewer", user_id=front.ann.id)
    await front.access.refresh()
    assert len(scene.cancelled()) == 1
    status = await scene.status(going)
    assert (status["state"], status["feedback"]) == ("canceled", None)
    assert "call on /count" in status["reason"]
    assert (await scene.status(done))["result"] is None
    with front.store.database.begin() as session:
        queries.revoke_right(session, front.rover.id, user_id=front.ann.id)
    await front.access.refresh()
    assert (await scene.status(done))["state"] == "succeeded"
    assert (await scene.service.members(scene.ann, TypedPageQuery()))["goals"]


@pytest_twisted.ensureDeferred
async def test_goals_are_their_owners(front: SessionsWorld) -> None:
    """Other users and other scopes do not see them; another token with the same scope does."""
    scene = await ready_world(front)
    goal = await scene.giving()
    with front.store.database.begin() as session:
        bob = queries.add_user(session, "bob", None)
        queries.grant_right(session, front.rover.id, "owner", user_id=bob.id)
    narrower = await front.by_token(front.ann, "operator")
    others = [scene.ann._replace(principal=each) for each in (await front.by_token(bob), narrower)]
    for other in (*others, scene.ann._replace(robot="hidden")):
        with pytest.raises(NotFound):
            scene.service.find(other, goal.id)
        with pytest.raises(NotFound):
            scene.service.cancel(other, goal.id)
    for other in others:
        assert (await scene.service.members(other, TypedPageQuery()))["goals"] == []
    hidden = scene.ann._replace(robot="hidden")
    assert isinstance(await refusal(scene.service.members(hidden, TypedPageQuery())), NotFound)
    same, _ = await front.logged_in()
    assert scene.service.find(scene.ann._replace(principal=same), goal.id) is goal
    assert len(goal.id) >= 40


@pytest_twisted.ensureDeferred
async def test_goals_are_listed_in_the_order_in_which_they_were_given(front: SessionsWorld) -> None:
    """In pages, filtered by action, without feedback and results."""
    scene = await ready_world(front)
    given = []
    for _ in range(3):
        scene.passes(0.25)
        given.append((await scene.giving()).id)
    scene.passes(0.25)
    await scene.giving(SPIN, earliest_sent=scene.world.now_ns())
    page = await scene.service.members(scene.ann, TypedPageQuery(name="/c*", limit=3))
    assert [each["id"] for each in page["goals"]][1:] == given[:2]
    assert "feedback" not in page["goals"][0]
    rest = await scene.service.members(scene.ann, TypedPageQuery(name="/c*", after=page["next"]))
    assert [each["id"] for each in rest["goals"]] == given[2:] and rest["next"] == ""
    assert (await scene.service.members(scene.ann, TypedPageQuery(type="other/action/Type")))["goals"] == []


@pytest_twisted.ensureDeferred
async def test_impossible_start_is_refused_with_a_reason(front: SessionsWorld) -> None:
    """No goal and no connection is left."""
    scene = await ready_world(front)
    wrong = await refusal(scene.giving(ask=GoalRequest(b'{"order":"five"}')))
    assert isinstance(wrong, NotDone) and "order" in str(wrong)
    assert isinstance(await refusal(scene.giving("/nowhere")), NotFound)
    assert isinstance(await refusal(scene.giving("no name!")), Invalid)
    assert isinstance(await refusal(scene.giving(ask=THREE._replace(type="no type"))), Invalid)
    with front.store.database.begin() as session:
        queries.grant_right(session, front.rover.id, "viewer", user_id=front.ann.id)
    await front.access.refresh()
    assert isinstance(await refusal(scene.giving()), Refused)
    assert len((await scene.service.members(scene.ann, TypedPageQuery()))["goals"]) == 1
    scene.passes(LINGER_SECONDS)
    assert not list(front.service)


@pytest_twisted.ensureDeferred
async def test_number_is_limited_per_user(front: SessionsWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    """Active goals are limited; of ended ones the newest are kept, by number and by size."""
    scene = await ready_world(front)
    monkeypatch.setattr(module, "UNDER_WAY", 2)
    monkeypatch.setattr(module, "KEPT", 2)
    goals = [await scene.giving(), await scene.giving()]
    assert isinstance(await refusal(scene.giving()), Unavailable)
    scene.finishes()
    goals.append(await scene.giving())
    scene.finishes()
    kept = {each["id"] for each in (await scene.service.members(scene.ann, TypedPageQuery()))["goals"]}
    assert kept == {each.id for each in goals[1:]}
    monkeypatch.setattr(module, "KEPT_BYTES", 1)
    last = await scene.giving()
    scene.finishes()
    (only,) = (await scene.service.members(scene.ann, TypedPageQuery()))["goals"]
    assert only["id"] == last.id


@pytest_twisted.ensureDeferred
async def test_too_long_event_is_not_stored(front: SessionsWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    """The goal says so."""
    monkeypatch.setattr(limits, "FEEDBACK_BYTES", 20)
    monkeypatch.setattr(limits, "RESULT_BYTES", 10)
    scene = await ready_world(front)
    goal = await scene.giving()
    scene.comes_so_far(*range(9))
    status = await scene.status(goal)
    assert status["feedback"] is None and "more than the 20 that are stored" in status["reason"]
    scene.comes_so_far(1)
    assert (await scene.status(goal))["reason"] is None
    scene.finishes()
    status = await scene.status(goal)
    assert (status["state"], status["result"]) == ("succeeded", None)
    assert "more than the 10 that are stored" in status["reason"]
