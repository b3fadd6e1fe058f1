"""Alerts to the relay, sent again where they may not have arrived."""

from __future__ import annotations

import pytest

from relay_protocol import link
from robot_client.alerts import MAX_ALERTS, STARTUP_NS, AlertReporter


class Relay:
    """A control link that works or not, and acknowledges or not."""

    def __init__(self) -> None:
        self.registered = False
        self.answered: int | None = None
        self.heard: list[str] = []

    def send(self, message: link.Message) -> None:
        """Report alerts by their texts."""
        if isinstance(message, link.Alert):
            self.heard.append(f"{message.about} {'over' if message.over else message.text}".strip())
        else:
            assert isinstance(message, link.ActiveAlertsSent)
            self.heard.append("that is all")


class Scene:
    """A robot and its relay."""

    def __init__(self) -> None:
        self.relay = Relay()
        self.now = 0
        self.reporter = AlertReporter(self.relay, lambda: self.now)

    def report(self, about: str, text: str = "broken", *, kind: str = "module", over: bool = False) -> None:
        """Report one alert."""
        self.now += 1
        self.reporter.report(link.Alert(level="error", text=text, kind=kind, about=about, over=over))

    def comes(self) -> list[str]:
        """Register the robot again; return what the relay receives."""
        self.relay.registered = True
        self.reporter.registered()
        return self.takes()

    def goes(self) -> None:
        """Lose the link."""
        self.relay.registered, self.relay.answered = False, None

    def takes(self) -> list[str]:
        """Return what the relay received since the last call."""
        heard, self.relay.heard = self.relay.heard, []
        return heard

    def proves(self) -> None:
        """Confirm all that was sent so far."""
        self.now += 1
        self.relay.answered = self.now
        self.reporter.flush()


@pytest.fixture
def scene() -> Scene:
    """A registered robot without alerts."""
    made = Scene()
    made.now = STARTUP_NS
    assert made.comes() == ["that is all"]
    return made


def test_report_is_completed_five_seconds_after_the_start() -> None:
    """Once in a registration, after the alerts until then."""
    scene = Scene()
    assert scene.comes() == []
    scene.now = STARTUP_NS // 2
    scene.goes()
    scene.reporter.flush()
    assert scene.comes() == []
    scene.now = STARTUP_NS
    scene.report("arm")
    assert scene.takes() == ["arm broken"]
    for _ in range(2):
        scene.reporter.flush()
    assert scene.takes() == ["that is all"]
    scene.goes()
    assert scene.comes() == ["arm broken", "that is all"]


def test_loss_of_control_is_sent_until_it_has_arrived(scene: Scene) -> None:
    """It is an event; alerts about a part of control last like others."""
    scene.goes()
    scene.report("", "lost", kind="control")
    scene.report("goals", "they go on", kind="control")
    assert scene.comes() == ["lost", "goals they go on", "that is all"]
    scene.goes()
    assert "lost" in scene.comes()
    scene.proves()
    scene.goes()
    assert scene.comes() == ["goals they go on", "that is all"]


def test_report_is_completed_at_the_next_registration() -> None:
    scene = Scene()
    scene.comes()
    scene.goes()
    scene.now = STARTUP_NS
    scene.reporter.flush()
    assert scene.takes() == []
    assert scene.comes() == ["that is all"]


def test_active_alerts_are_sent_at_each_registration(scene: Scene) -> None:
    scene.report("arm")
    scene.proves()
    scene.report("leg")
    assert scene.takes() == ["arm broken", "leg broken"]
    scene.goes()
    assert scene.comes() == ["arm broken", "leg broken", "that is all"]
    scene.goes()
    assert scene.comes() == ["arm broken", "leg broken", "that is all"]


def test_unconfirmed_alerts_are_sent_again(scene: Scene) -> None:
    """Ends and single events too; of confirmed alerts only the active ones."""
    scene.report("arm")
    scene.report("", "look", kind="")
    scene.proves()
    scene.report("arm", over=True)
    scene.report("", "look again", kind="")
    scene.takes()
    scene.goes()
    assert scene.comes() == ["arm over", "look again", "that is all"]
    scene.proves()
    scene.goes()
    assert scene.comes() == ["that is all"]


def test_ended_alert_is_not_sent_as_a_beginning_again(scene: Scene) -> None:
    """Unless its beginning was never sent."""
    scene.report("arm")
    scene.takes()
    scene.goes()
    scene.report("arm", over=True)
    scene.report("leg")
    scene.report("leg", over=True)
    assert scene.takes() == []
    assert scene.comes() == ["arm over", "leg broken", "leg over", "that is all"]


def test_memory_is_bounded_and_an_incomplete_report_is_not_completed(scene: Scene) -> None:
    """The relay would end alerts that still last."""
    for each in range(MAX_ALERTS + 1):
        scene.report(f"part {each}")
    scene.proves()
    assert len(scene.takes()) == MAX_ALERTS + 1
    scene.goes()
    reported = scene.comes()
    assert len(reported) == MAX_ALERTS
    assert "that is all" not in reported
    for each in range(MAX_ALERTS + 1):
        scene.report(f"part {each}", over=True)
    scene.proves()
    scene.goes()
    scene.takes()
    assert scene.comes() == ["that is all"]


def test_single_events_do_not_displace_active_alerts(scene: Scene) -> None:
    scene.report("arm")
    scene.goes()
    for each in range(2 * MAX_ALERTS):
        scene.report("", f"word {each}", kind="")
    scene.takes()
    reported = scene.comes()
    assert reported[0] == "arm broken"
    assert reported[1:] == [f"word {each}" for each in range(MAX_ALERTS, 2 * MAX_ALERTS)] + ["that is all"]
