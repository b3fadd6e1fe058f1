"""Pipes between two topics of a robot in memory, on a real database."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import pytest_twisted
from sqlalchemy.orm import Session
from twisted.internet.defer import Deferred

from relay_db import queries
from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound, Refused
from relay_protocol.scopes import Scope
from relay_server.access import Principal
from relay_server.channels.samples import Converter
from relay_server.cluster.relays import RelayInfo
from relay_server.pipes import service as module
from relay_server.pipes.running_pipe import RunningPipe
from relay_server.pipes.schemas import FieldMapping, NewPipe, PipeEnd, PipeList
from relay_server.pipes.service import PipeUser, local_pipe_user, merge_pipes, pipe_user
from tests.worlds.pipes import PipeScene, copy, settled
from tests.worlds.relay import STRING, TWIST, Person, text, words
from tests.worlds.session_manager import HERE

COPY = PipeEnd("rover", "/copy", STRING)


@pytest_twisted.ensureDeferred
async def test_whole_messages_are_carried_without_decoding(
    scene: PipeScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded: list[str] = []
    monkeypatch.setattr(Converter, "convert", lambda self, language, body: decoded.append(language) or b"{}")
    ann = await scene.begin()
    added = await scene.service.add(ann, copy())
    assert (added.state, added.owner) == ("waiting", "ann")
    scene.joins()
    assert await scene.state(ann) == ("running", "")
    scene.sends(text("hello"))
    scene.sends(b"\x00\x01\x00\x00 no message at all")
    assert scene.carried == [text("hello"), b"\x00\x01\x00\x00 no message at all"]
    assert decoded == []
    found = await scene.service.pipe(ann, "copy")
    assert (found.messages, found.encoded, found.drops, found.moves) == (2, 2, 0, False)


@pytest_twisted.ensureDeferred
async def test_drops_on_the_slow_link_of_the_target_are_shown(scene: PipeScene) -> None:
    ann = await scene.begin()
    await scene.service.add(ann, copy())
    scene.joins()
    scene.sends(text("hello"))
    ((number, _, _),) = scene.world.link.samples
    for each in list(scene.front.service):
        scene.world.channel.publications.message_dropped(number, each.number)
    found = await scene.service.pipe(ann, "copy")
    assert (found.state, found.drops) == ("running", 1)
    assert found.why.startswith("publish /copy: messages are dropped, as the robot's link is too slow")


@pytest_twisted.ensureDeferred
async def test_fields_are_carried_in_one_message(scene: PipeScene) -> None:
    ann = await scene.begin()
    mapping = FieldMapping("data", "data", table={"left": "port"})
    await scene.service.add(ann, copy(type=STRING, fields=[mapping]))
    scene.joins()
    scene.sends(text("left"))
    scene.sends(text("right"))
    assert [words(each) for each in scene.carried] == ["port"]
    found = await scene.service.pipe(ann, "copy")
    assert (found.messages, found.encoded, found.drops) == (1, 0, 1)
    assert found.why == "'right' of 'data' is not in the table"


@pytest.mark.parametrize(
    ("pipe", "reason"),
    [
        (copy(target="/cmd_vel"), "whole messages need the same type"),
        (copy(target="/cmd_vel", fields=[FieldMapping("data", "linear.x")]), "give a table"),
        (copy(target="/cmd_vel", fields=[FieldMapping("word", "linear.x")]), "no field 'word'"),
    ],
)
@pytest_twisted.ensureDeferred
async def test_types_that_do_not_fit_are_refused_before_it_starts(
    scene: PipeScene, pipe: NewPipe, reason: str
) -> None:
    ann = await scene.begin()
    await scene.service.add(ann, pipe)
    scene.joins()
    await settled(scene)
    state, why = await scene.state(ann)
    assert state == "refused"
    assert reason in why
    assert not scene.world.link.all(link.Subscribe)


@pytest_twisted.ensureDeferred
async def test_it_waits_for_a_topic_and_for_its_robot(scene: PipeScene) -> None:
    ann = await scene.begin()
    await scene.service.add(ann, copy(source="/later"))
    scene.joins()
    assert await scene.state(ann) == ("waiting", "waiting for topic /later of robot rover")
    scene.world.robot_goes()
    scene.passes(module.CHECK_SECONDS)
    assert await scene.state(ann) == ("waiting", "waiting for robot rover, which is offline")


@pytest_twisted.ensureDeferred
async def test_a_lost_right_ends_it_and_it_stays_ended(scene: PipeScene) -> None:
    ann = await scene.begin()
    await scene.service.add(ann, copy())
    scene.joins()
    await scene.front.store.write(
        queries.grant_right,
        scene.front.rover.id,
        "operator",
        user_id=scene.front.ann.id,
        deny=["publish:/copy"],
    )
    await scene.front.access.refresh()
    scene.sends(text("hello"))
    assert scene.carried == []
    await settled(scene)
    state, why = await scene.state(ann)
    assert state == "refused"
    assert "/copy" in why
    await scene.front.store.write(
        queries.grant_right, scene.front.rover.id, "operator", user_id=scene.front.ann.id
    )
    await scene.front.access.refresh()
    scene.passes(10)
    assert (await scene.state(ann))[0] == "refused"
    assert [each.data["pipe"] for each in scene.front.events("pipe.ended")] == ["copy"]


@pytest_twisted.ensureDeferred
async def test_it_ends_when_its_owner_has_no_right_any_more(scene: PipeScene) -> None:
    ann = await scene.begin()
    await scene.service.add(ann, copy())
    scene.joins()
    await scene.front.store.write(queries.revoke_right, scene.front.rover.id, user_id=scene.front.ann.id)
    await scene.front.access.refresh()
    await settled(scene)
    assert (await scene.state(local_pipe_user("root")))[0] == "refused"
    assert not list(scene.front.service)


@pytest_twisted.ensureDeferred
async def test_it_outlasts_the_token_with_which_it_was_added(scene: PipeScene) -> None:
    ann, _ = await scene.front.logged_in()
    user = await scene.begin()
    await scene.service.add(user, copy())
    scene.joins()
    await scene.front.logins.logout(ann)
    scene.sends(text("hello"))
    assert len(scene.carried) == 1


@pytest_twisted.ensureDeferred
async def test_it_goes_on_after_a_restart_of_the_relay(scene: PipeScene) -> None:
    ann = await scene.begin()
    await scene.service.add(ann, copy())
    scene.joins()
    scene.service.leave("restart")
    scene.service = scene.new_service()
    await scene.service.start()
    await settled(scene)
    scene.answers()
    assert (await scene.state(ann))[0] == "running"


@pytest_twisted.ensureDeferred
async def test_stopped_and_removed(scene: PipeScene) -> None:
    ann = await scene.begin()
    await scene.service.add(ann, copy(start=False))
    assert await scene.state(ann) == ("stopped", "")
    await scene.service.start_pipe(ann, "copy")
    scene.joins()
    assert (await scene.service.stop_pipe(ann, "copy")).state == "stopped"
    assert not list(scene.front.service)
    await scene.service.remove(ann, "copy")
    assert (await scene.service.pipes(ann)).pipes == []
    actions = [each.action for each in await scene.front.store.read(queries.list_audit)]
    assert [each for each in actions if each.startswith("pipe.")] == [
        "pipe.remove", "pipe.stop", "pipe.start", "pipe.add",
    ]  # fmt: skip


@pytest_twisted.ensureDeferred
async def test_cycles_are_refused_unless_a_rate_breaks_them(scene: PipeScene) -> None:
    ann = await scene.begin()
    await scene.service.add(ann, copy("there"))
    with pytest.raises(Refused, match=r"feed itself \(back → there → back\)"):
        await scene.service.add(ann, copy("back", "/copy", "/chatter"))
    assert [each.name for each in (await scene.service.pipes(ann)).pipes] == ["there"]
    await scene.service.add(ann, copy("back", "/copy", "/chatter", rate=1.0))
    with pytest.raises(Invalid, match="the same topic"):
        await scene.service.add(ann, copy("self", "/copy", "copy"))


@pytest_twisted.ensureDeferred
async def test_a_cycle_does_not_name_the_pipes_of_others(scene: PipeScene) -> None:
    ann = await scene.begin()
    await scene.service.add(ann, copy("secret"))
    user = await another(scene)
    await scene.front.store.write(queries.grant_right, scene.front.rover.id, "operator", user_id=user.id)
    bob = pipe_user(await scene.front.by_token(user), HERE)
    with pytest.raises(Refused, match=r"feed itself \(back → a pipe of another user → back\)"):
        await scene.service.add(bob, copy("back", "/copy", "/chatter"))


@pytest_twisted.ensureDeferred
async def test_one_user_has_so_many_pipes_at_most(scene: PipeScene, monkeypatch: pytest.MonkeyPatch) -> None:
    ann = await scene.begin()
    monkeypatch.setattr("relay_db.queries.pipes.MAX_PIPES_OF_USER", 1)
    await scene.service.add(ann, copy("first"))
    with pytest.raises(Refused, match="most that one user may have"):
        await scene.service.add(ann, copy("second"))
    with pytest.raises(Invalid, match="are for the pipes of Roles"):
        await scene.service.add(ann, copy("role-1-1"))


@pytest_twisted.ensureDeferred
async def test_mappings_that_write_into_each_other_are_refused(scene: PipeScene) -> None:
    ann = await scene.begin()
    for targets in (("a", "a"), ("a.b", "a"), ("a", "a.b.c"), ("a", "a_b", "a.b")):
        fields = [FieldMapping("data", each) for each in targets]
        with pytest.raises(Invalid, match="two mappings write 'a"):
            await scene.service.add(
                ann, NewPipe(name="x", source=PipeEnd("rover", "/chatter"), target=COPY, fields=fields)
            )


@pytest_twisted.ensureDeferred
async def test_an_error_of_the_relay_ends_the_pipe_and_not_the_data_of_others(
    scene: PipeScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    ann = await scene.begin()
    await scene.service.add(ann, copy())
    scene.joins()

    def fails(*_: object) -> bool:
        raise TypeError("not foreseen")

    monkeypatch.setattr(RunningPipe, "_carry", fails)
    scene.sends(text("hello"))
    await settled(scene)
    assert await scene.state(ann) == ("refused", "the relay failed on a message; see its log")


@pytest_twisted.ensureDeferred
async def test_repeated_stops_are_audited_once(scene: PipeScene) -> None:
    ann = await scene.begin()
    await scene.service.add(ann, copy())
    for _ in range(5):
        await scene.service.stop_pipe(ann, "copy")
    actions = [each.action for each in await scene.front.store.read(queries.list_audit)]
    assert [each for each in actions if each.startswith("pipe.")] == ["pipe.stop", "pipe.start", "pipe.add"]


@pytest_twisted.ensureDeferred
async def test_robots_without_a_right_can_not_be_named(scene: PipeScene) -> None:
    ann = await scene.begin()
    for robot in ("hidden", "nowhere", "rover@nowhere"):
        with pytest.raises(NotFound):
            await scene.service.add(
                ann, NewPipe(name="x", source=PipeEnd(robot, "/a"), target=PipeEnd("rover", "/b"))
            )
    with pytest.raises(Refused):
        pipe_user(Principal(1, "ann", "default", False, 1, None, Scope("viewer@rover")), HERE)


@pytest_twisted.ensureDeferred
async def test_in_another_realm_it_goes_as_far_as_the_rights_of_the_account_there(scene: PipeScene) -> None:
    """The target is the same robot, shared with another realm in which ann has other rights on it."""
    front, ann = scene.front, await scene.begin()

    def share(s: Session) -> int:
        queries.add_realm(s, "lab2")
        queries.share_robot(s, front.rover.id, "lab2")
        return queries.add_linked_account(s, front.ann.id, "lab2").id

    async def grant(level: str) -> None:
        await front.store.write(queries.grant_right, front.rover.id, level, user_id=account)
        await front.access.refresh()

    account = await front.store.write(share)
    pipe = NewPipe(name="copy", source=PipeEnd("rover", "/chatter"), target=PipeEnd("rover@lab2", "/copy"))
    with pytest.raises(NotFound, match="no right"):
        await scene.service.add(ann, pipe)
    await grant("viewer")
    await scene.service.add(ann, pipe)
    scene.joins()
    await settled(scene)
    state, why = await scene.state(ann)
    assert (state, "/copy" in why) == ("refused", True), why
    await grant("operator")
    await scene.service.start_pipe(ann, "copy")
    scene.answers()
    scene.sends(text("hello"))
    assert (await scene.state(ann), len(scene.carried)) == (("running", ""), 1)
    await front.store.write(queries.revoke_right, front.rover.id, user_id=account)
    await front.access.refresh()
    await settled(scene)
    scene.sends(text("hello"))
    assert ((await scene.state(ann))[0], len(scene.carried)) == ("refused", 1)


# --- pipes that move the robot -------------------------------------------------------------------------------


async def driving(scene: PipeScene) -> PipeUser:
    """A pipe into /cmd_vel has control and drives."""
    ann = await scene.begin()
    scene.world.registry.described(
        scene.world.robot, link.Describe(motion=link.MotionPolicy(types=[TWIST], deadline_ms=500))
    )
    await scene.service.add(
        ann, copy(target="/cmd_vel", fields=[FieldMapping("data", "linear.x", table={"on": 0.5, "off": 0})])
    )
    scene.joins()
    scene.pongs()
    return ann


@pytest_twisted.ensureDeferred
async def test_it_takes_control_like_a_client(scene: PipeScene) -> None:
    ann = await driving(scene)
    scene.sends(text("on"))
    scene.passes(0.01)
    holder = scene.world.controllers.of(scene.world.robot).lease.holder
    assert holder is not None and (holder.client.name, holder.client.address) == ("ann", "pipe copy")
    assert len(scene.world.link.commands) == 1
    assert (await scene.service.pipe(ann, "copy")).moves


@pytest_twisted.ensureDeferred
async def test_a_command_that_may_be_too_old_is_not_carried(scene: PipeScene) -> None:
    """The robot answers no ping, so its messages may have waited."""
    ann = await driving(scene)
    scene.passes(0.6)
    scene.sends(text("on"))
    assert scene.world.link.commands == []
    found = await scene.service.pipe(ann, "copy")
    assert (found.state, found.drops) == ("running", 1)


@pytest_twisted.ensureDeferred
async def test_a_command_that_is_too_old_by_its_stamp_is_not_carried(scene: PipeScene) -> None:
    """The pings are answered, but this message waited in the robot for longer than others."""
    ann = await driving(scene)
    scene.sends(text("on"))
    scene.passes(0.01)
    assert len(scene.world.link.commands) == 1
    for waited, carried in ((0.4, 2), (0.6, 2), (0.0, 3)):
        scene.pongs()
        scene.sends(text("on"), stamp=scene.world.now_ns() - round(waited * 1e9))
        assert len(scene.world.link.commands) == carried, waited
    found = await scene.service.pipe(ann, "copy")
    assert (found.state, found.why, found.messages, found.drops) == ("running", "", 3, 1)


@pytest_twisted.ensureDeferred
async def test_it_can_be_started_again_at_once(scene: PipeScene) -> None:
    """It was stopped while it drove; that is no drive which goes on by itself."""
    ann = await driving(scene)
    scene.sends(text("on"))
    scene.passes(0.01)
    await scene.service.stop_pipe(ann, "copy")
    await scene.service.start_pipe(ann, "copy")
    scene.answers(1)
    scene.pongs()
    for _ in range(3):
        scene.sends(text("on"))
        scene.passes(0.01)
    assert (await scene.state(ann)) == ("running", "")
    holder = scene.world.controllers.of(scene.world.robot).lease.holder
    assert holder is not None and holder.client.address == "pipe copy"
    assert len(scene.world.link.commands) > 1


async def stopped(scene: PipeScene) -> None:
    scene.front.bus.publish("robot.stopped", scene.world.robot.robot_id)


async def handed_over(scene: PipeScene) -> None:
    """Another client asks for control, and gets it."""
    await scene.front.store.write(
        queries.grant_right, scene.front.rover.id, "operator", user_id=(await another(scene)).id
    )
    boss = await scene.front.connected(await scene.front.by_token(await another(scene)))
    controller = scene.world.controllers.of(scene.world.robot)
    await controller.take(boss, "")
    assert controller.lease.holder is not None
    controller.grant(controller.lease.holder.client, "")
    scene.passes(0.01)


async def taken_over(scene: PipeScene) -> None:
    """An owner asks for control, and asks again after the grace time."""
    user = await another(scene)
    await scene.front.store.write(queries.grant_right, scene.front.rover.id, "owner", user_id=user.id)
    person = Person(*await scene.front.opens(await scene.front.by_token(user)))
    boss, controller = person.context, scene.world.controllers.of(scene.world.robot)
    assert not (await controller.take(boss, "")).success
    for _ in range(31):
        person.answers_pings()
        scene.passes(1)
    assert (await controller.take(boss, "")).success
    assert controller.may_command(boss, "/cmd_vel")


async def another(scene: PipeScene) -> Any:
    found = await scene.front.store.read(queries.find_user, "boss")
    if found is None:
        await scene.front.store.write(queries.add_user, "boss", None)
        found = await scene.front.store.read(queries.find_user, "boss")
    return found


async def robot_offline(scene: PipeScene) -> None:
    scene.world.robot_goes()
    scene.passes(module.CHECK_SECONDS)


async def lost_right(scene: PipeScene) -> None:
    await scene.front.store.write(
        queries.grant_right, scene.front.rover.id, "viewer", user_id=scene.front.ann.id
    )
    await scene.front.access.refresh()


@pytest.mark.parametrize("ends", [stopped, handed_over, taken_over, robot_offline, lost_right])
@pytest_twisted.ensureDeferred
async def test_it_ends_and_does_not_move_the_robot_again_by_itself(scene: PipeScene, ends: Any) -> None:
    ann = await driving(scene)
    scene.sends(text("on"))
    scene.passes(0.01)
    assert len(scene.world.link.commands) == 1
    await ends(scene)
    before = len(scene.world.link.commands)
    await settled(scene)
    assert (await scene.state(ann))[0] == "refused"
    scene.passes(30)
    assert len(scene.world.link.commands) == before
    assert not [each for each in scene.front.service if each.address == "pipe copy"]


@pytest_twisted.ensureDeferred
async def test_after_a_restart_of_the_relay_it_does_not_move_the_robot(scene: PipeScene) -> None:
    ann = await driving(scene)
    scene.service.leave("restart")
    scene.service = scene.new_service()
    await scene.service.start()
    await settled(scene)
    scene.answers()
    await settled(scene)
    state, why = await scene.state(ann)
    assert state == "refused"
    assert "start it again" in why


class TwoRelays:
    """Homes of robots, seen by the relay ``own`` (:class:`~relay_server.cluster.homes.RobotHomes`).

    :ivar home: of all robots
    """

    def __init__(self) -> None:
        self.home = "one"

    def seen_by(self, own: str) -> Any:
        """The homes, as this relay sees them."""
        other = RelayInfo("other", "other.example.org", 9092, "1.0", 1.0)
        return SimpleNamespace(elsewhere=lambda robot: None if self.home == own else other)


@pytest_twisted.ensureDeferred
async def test_a_pipe_runs_at_the_home_of_its_target(scene: PipeScene) -> None:
    """Wherever it was started. It is stopped there too, and lists of all relays show its state there."""
    relays = TwoRelays()
    first, second = (scene.new_service(relays.seen_by(name)) for name in ("one", "two"))
    ann = await scene.begin()
    for each in (first, second):
        await each.start()

    def run_at() -> list[str]:
        relays = {"one": first, "two": second}
        return [name for name, each in relays.items() if each._running or each._unopened]

    async def until(names: list[str]) -> None:
        for _ in range(200):
            if run_at() == names:
                return
            scene.passes(module.OPEN_SECONDS)
            await settled(scene)
        assert run_at() == names

    await second.add(ann, copy())
    await until(["one"])
    (own,), others = (await first.pipes(ann)).pipes, await second.pipes(ann)
    assert merge_pipes(others, [PipeList([own])]).pipes == [own]
    assert own.state == "waiting"
    assert await first.relay_of(ann, "copy") is None
    assert await second.relay_of(ann, "copy") is not None
    relays.home = "two"
    await until(["two"])
    await first.stop_pipe(ann, "copy")
    await until([])
    for each in (first, second):
        each.leave("the test ends")


@pytest.mark.parametrize("order", ["stop_pipe", "remove"])
@pytest_twisted.ensureDeferred
async def test_an_order_during_a_start_wins(
    scene: PipeScene, monkeypatch: pytest.MonkeyPatch, order: str
) -> None:
    """It came later. Else a pipe would run that nothing stops."""
    ann = await scene.begin()
    await scene.service.add(ann, copy(name="copy", start=False))
    write, begun, go_on = scene.service._database.write, Deferred[None](), Deferred[None]()

    async def held(work: Any, *args: Any) -> Any:
        done = await write(work, *args)
        if work == scene.service._enable:
            begun.callback(None)
            await go_on
        return done

    monkeypatch.setattr(scene.service._database, "write", held)
    starting = Deferred.fromCoroutine(scene.service.start_pipe(ann, "copy"))
    await begun
    ordering = Deferred.fromCoroutine(getattr(scene.service, order)(ann, "copy"))
    await settled(scene)
    assert not ordering.called
    go_on.callback(None)
    starting.addErrback(lambda failure: failure.trap(NotFound))
    await starting
    await ordering
    await settled(scene)
    assert not scene.service._running
    assert not scene.service._unopened
    assert not scene.service._locks
    listed = [(each.name, each.state) for each in (await scene.service.pipes(ann)).pipes]
    assert listed == ([("copy", "stopped")] if order == "stop_pipe" else [])
