"""A stop sets the hardware switch, and a resume releases it."""

from __future__ import annotations

import pytest
from twisted.internet.defer import Deferred

from relay_protocol import link
from relay_protocol.errors import Unavailable
from robot_client.motion.guard_protocol import CANCEL
from robot_client.motion.hardware import FREQUENT_RETRIES, RARE_RETRY_INTERVAL, SWITCH_SECONDS
from robot_client.platforms.base import GraphView
from tests.worlds.robot_commands import (
    BEFORE,
    NAVIGATE,
    NO_GOALS_ANSWER,
    ZERO,
    SwitchWorld,
    messages_of,
    order,
    resume,
    stop,
)


def test_only_the_answer_of_a_stop_waits_for_the_hardware() -> None:
    """Zero is published first."""
    switched = SwitchWorld()
    switched.control.send(stop())
    assert switched.scene.platform.published[-1] == ("/cmd_vel", ZERO)
    assert switched.asked == [b"\0\1\0\0\1"]
    assert switched.done() == []
    switched.answer(True)
    assert switched.done() == [{"op": "order_result", "id": 2}]
    switched.control.send(resume())
    assert switched.asked[1:] == [b"\0\1\0\0\0"]
    switched.answer(True)
    assert switched.done() == [{"op": "order_result", "id": 3}]
    assert switched.scene.daemon.authority.stopped is None


def test_trigger_is_called_at_a_stop_only() -> None:
    switched = SwitchWorld("std_srvs/srv/Trigger")
    switched.control.send(stop())
    switched.answer(True)
    switched.control.send(resume())
    assert [each["id"] for each in switched.done()] == [2, 3]
    assert switched.asked == [b"\0\1\0\0\0"]


def test_failing_hardware_is_reported_and_the_robot_stays_stopped() -> None:
    """At a stop and at a resume."""
    switched = SwitchWorld()
    switched.control.send(stop())
    switched.answer(False, "fuse \x1b blown")
    received = [each for each in switched.control.received() if isinstance(each, dict)]
    (done,) = [each for each in received if each["op"] == "order_result"]
    assert done["ok"] is False
    assert r"fuse \x1b blown" in done["reason"]
    assert any("fuse" in each["text"] for each in received if each["op"] == "alert")
    switched.control.send(resume())
    switched.answer(False)
    switched.answer(True)
    assert switched.done()[0]["ok"] is False
    assert switched.scene.daemon.authority.stopped is not None


def test_hardware_released_by_a_failed_resume_is_stopped_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stop is stored again too."""
    switched = SwitchWorld()
    switched.control.send(stop())
    switched.answer(True)

    def half_gone() -> None:
        switched.scene.stop_store.stopped = None
        raise Unavailable("the disk is read-only")

    monkeypatch.setattr(switched.scene.stop_store, "clear", half_gone)
    switched.control.received()
    switched.control.send(resume())
    switched.answer(True)
    assert switched.asked == [b"\0\1\0\0\1", b"\0\1\0\0\0", b"\0\1\0\0\1"]
    switched.control.send(stop(4), resume(5))
    assert [(each["id"], each["ok"]) for each in switched.done()] == [(5, False)]
    switched.answer(True)
    (first, second) = switched.done()
    assert (first["id"], first["ok"], first["reason"]) == (3, False, "the disk is read-only")
    assert second == {"op": "order_result", "id": 4}
    assert switched.scene.stop_store.stopped is not None
    assert switched.scene.daemon.authority.stopped is not None


def test_switch_that_fails_at_a_resume_is_set_again() -> None:
    """It may have been released in part."""
    switched = SwitchWorld()
    switched.control.send(stop())
    switched.answer(True)
    switched.control.received()
    switched.control.send(resume())
    switched.answer(False, "stuck")
    assert switched.done() == []
    assert switched.asked[-1] == b"\0\1\0\0\1"
    switched.answer(False, "fuse blown")
    (done,) = switched.done()
    assert ("stuck" in done["reason"], "fuse blown" in done["reason"]) == (True, True)


def test_silent_hardware_times_out_after_five_seconds() -> None:
    """All stops that wait get that answer."""
    switched = SwitchWorld()
    switched.control.send(stop(), stop(5))
    assert len(switched.asked) == 1
    for _ in range(round(SWITCH_SECONDS) + 1):
        switched.control.send(link.Ping(t=1))
        switched.scene.clock.advance(1)
    done = switched.done()
    assert [(each["id"], each["ok"]) for each in done] == [(2, False), (5, False)]
    assert "did not answer" in done[0]["reason"]


@pytest.mark.parametrize(("types", "words"), [([], "no service"), (["a/srv/B"], "neither")])
def test_missing_or_unsuitable_service_fails_at_once(types: list[str], words: str) -> None:
    switched = SwitchWorld()
    services = {"/estop": link.Service(types=types)} if types else {}
    switched.scene.platform.view = GraphView(services=services)
    switched.control.send(stop())
    (done,) = switched.done()
    assert (done["ok"], words in done["reason"]) == (False, True)


def test_stop_during_a_resume_wins() -> None:
    switched = SwitchWorld()
    switched.control.send(stop())
    switched.answer(True)
    switched.control.send(resume())
    switched.control.send(stop(4))
    switched.answer(True)
    switched.answer(True)
    assert [(each["id"], each.get("ok", True)) for each in switched.done()] == [(2, True), (3, False)]
    switched.answer(True)
    assert [(each["id"], each.get("ok", True)) for each in switched.done()] == [(4, True)]
    assert switched.scene.daemon.authority.stopped is not None
    assert switched.asked[-1] == b"\0\1\0\0\1"


def test_failed_switch_is_set_again() -> None:
    """Each second for half a minute, then every ten; one alert for its failure, one for its end."""
    switched = SwitchWorld()
    switched.control.send(stop())
    switched.answer(False, "fuse blown")
    ((text, over),) = [(each["text"], each.get("over")) for each in messages_of(switched.control, "alert")]
    assert ("fuse blown" in text, over) == (True, None)
    switched.pass_seconds(FREQUENT_RETRIES, good=False)
    assert len(switched.asked) == 1 + FREQUENT_RETRIES
    switched.pass_seconds(10 * RARE_RETRY_INTERVAL, good=False)
    assert len(switched.asked) == 1 + FREQUENT_RETRIES + 10
    alerts = switched.pass_seconds(RARE_RETRY_INTERVAL, good=True)
    assert alerts == [("the hardware switch is set", True)]
    asked = len(switched.asked)
    assert switched.pass_seconds(100) == []
    assert len(switched.asked) == asked
    assert set(switched.asked) == {b"\0\1\0\0\1"}


def test_service_that_was_found_is_called_although_it_left_the_graph() -> None:
    """Its client is prepared at the start."""
    switched = SwitchWorld()
    switched.pass_seconds(2)
    assert switched.scene.platform.prepared_calls == [("/estop", "std_srvs/srv/SetBool")]
    switched.scene.platform.view = GraphView()
    switched.control.send(stop())
    assert switched.asked == [b"\0\1\0\0\1"]


def test_resume_waits_while_a_switch_is_set_again() -> None:
    switched = SwitchWorld()
    switched.control.send(stop())
    switched.answer(False)
    switched.pass_seconds(1)
    switched.control.send(resume())
    assert switched.asked == 2 * [b"\0\1\0\0\1"]
    switched.answer(True)
    assert switched.asked[2:] == [b"\0\1\0\0\0"]
    switched.answer(True)
    assert switched.done()[-1] == {"op": "order_result", "id": 3}
    switched.control.send(stop(4))
    switched.answer(False)
    switched.pass_seconds(1)
    switched.asked.clear()
    switched.control.send(resume(5))
    switched.control.send(stop(6))
    for _ in range(3):
        while switched.answers:
            switched.answer(True)
    assert [(each["id"], each.get("ok", True)) for each in switched.done()] == [(5, False), (6, True)]
    assert set(switched.asked) == {b"\0\1\0\0\1"}
    assert switched.scene.daemon.authority.stopped is not None


def test_resume_ends_the_alert_about_the_hardware() -> None:
    switched = SwitchWorld("std_srvs/srv/Trigger")
    switched.control.send(stop())
    switched.answer(False)
    switched.control.received()
    switched.control.send(resume())
    assert [each["over"] for each in messages_of(switched.control, "alert")] == [True]
    asked = len(switched.asked)
    switched.pass_seconds(5)
    assert len(switched.asked) == asked


def test_resume_during_a_stop_is_refused() -> None:
    switched = SwitchWorld()
    switched.control.send(stop())
    switched.control.send(resume())
    (done,) = switched.done()
    assert (done["id"], done["ok"]) == (3, False)


def test_daemon_that_starts_stopped_sets_the_switch_when_it_appears() -> None:
    """Once, within half a minute."""
    switched = SwitchWorld(stopped=BEFORE)
    view, switched.scene.platform.view = switched.scene.platform.view, GraphView()
    for _ in range(20):
        switched.scene.clock.advance(1)
        switched.control.send(link.Ping(t=1))
    assert switched.asked == []
    switched.scene.platform.view = view
    for _ in range(20):
        switched.scene.clock.advance(1)
        switched.control.send(link.Ping(t=1))
        if switched.answers:
            switched.answer(True)
    assert switched.asked == [b"\0\1\0\0\1"]
    assert messages_of(switched.control, "alert") == []


@pytest.mark.parametrize("there", [True, False])
def test_switch_that_can_not_be_set_after_a_start_raises_an_alert(there: bool) -> None:
    """It fails, or does not appear within half a minute."""
    switched = SwitchWorld(stopped=BEFORE)
    if not there:
        switched.scene.platform.view = GraphView()
    for _ in range(40):
        switched.scene.clock.advance(1)
        switched.control.send(link.Ping(t=1))
        if switched.answers:
            switched.answer(False, "fuse blown")
    (alert,) = messages_of(switched.control, "alert")
    assert ("fuse blown" if there else "no service /estop") in alert["text"]


def test_stop_while_a_switch_is_set_again_is_complete() -> None:
    switched = SwitchWorld(stopped=BEFORE)
    platform = switched.scene.platform
    cancelled: list[Deferred[bytes]] = []

    def cancel(request: bytes) -> Deferred[bytes]:
        cancelled.append(Deferred())
        return cancelled[-1]

    switched.pass_seconds(2)
    assert len(switched.answers) == 1  # active since the start
    platform.services[NAVIGATE + CANCEL] = cancel
    actions = {NAVIGATE: link.Service(types=["a/action/B"])}
    platform.view = GraphView(services=platform.view.services, actions=actions)
    switched.control.send(stop())
    assert len(cancelled) == 1
    while switched.answers:
        switched.answer(True)
    assert switched.done() == []
    cancelled[0].callback(NO_GOALS_ANSWER)
    assert switched.done() == [{"op": "order_result", "id": 2}]


def test_resume_ends_the_wait_for_the_service() -> None:
    switched = SwitchWorld("std_srvs/srv/Trigger", BEFORE)
    view, switched.scene.platform.view = switched.scene.platform.view, GraphView()
    switched.scene.clock.advance(1)
    switched.scene.platform.view = view
    assert order(switched.control, resume()) == {"op": "order_result", "id": 3}
    switched.scene.run(5)
    assert switched.asked == []
