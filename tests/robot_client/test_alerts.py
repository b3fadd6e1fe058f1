"""What the relay is told of alerts, and told again when it may not have heard."""

from __future__ import annotations

import pytest

from relay_protocol import link
from robot_client.alerts import HEARING_NS, KEPT, AlertMemory


class Relay:
    """The control link, which hears or does not, and says so or does not."""

    def __init__(self) -> None:
        self.registered = False
        self.answered: int | None = None
        self.heard: list[str] = []

    def say(self, message: link.Message) -> None:
        """Words, in short."""
        if isinstance(message, link.Alert):
            self.heard.append(f"{message.about} {'over' if message.over else message.text}".strip())
        else:
            assert isinstance(message, link.AlertsTold)
            self.heard.append("that is all")


class Scene:
    """A robot and its relay."""

    def __init__(self) -> None:
        self.relay = Relay()
        self.now = 0
        self.memory = AlertMemory(self.relay, lambda: self.now)

    def tell(self, about: str, text: str = "broken", *, kind: str = "module", over: bool = False) -> None:
        """One alert."""
        self.now += 1
        self.memory.tell(link.Alert(level="error", text=text, kind=kind, about=about, over=over))

    def comes(self) -> list[str]:
        """The relay knows the robot again; what it hears."""
        self.relay.registered = True
        self.memory.registered()
        return self.takes()

    def goes(self) -> None:
        """The link is lost."""
        self.relay.registered, self.relay.answered = False, None

    def takes(self) -> list[str]:
        """What the relay heard since it was asked last."""
        heard, self.relay.heard = self.relay.heard, []
        return heard

    def proves(self) -> None:
        """What was said so far has arrived."""
        self.now += 1
        self.relay.answered = self.now
        self.memory.look()


@pytest.fixture
def scene() -> Scene:
    """The relay knows the robot; nothing is wrong."""
    made = Scene()
    made.now = HEARING_NS
    assert made.comes() == ["that is all"]
    return made


def test_a_daemon_that_has_just_begun_hears_before_it_says_that_is_all() -> None:
    """In the registration that lasts then, once; what it hears until then comes first."""
    scene = Scene()
    assert scene.comes() == []
    scene.now = HEARING_NS // 2
    scene.goes()
    scene.memory.look()
    assert scene.comes() == []
    scene.now = HEARING_NS
    scene.tell("arm")
    assert scene.takes() == ["arm broken"]
    for _ in range(2):
        scene.memory.look()
    assert scene.takes() == ["that is all"]
    scene.goes()
    assert scene.comes() == ["arm broken", "that is all"]


def test_a_loss_of_control_is_told_until_it_is_heard_and_no_more(scene: Scene) -> None:
    """It has happened; what is wrong with a part of what controls the robot lasts, as with any other."""
    scene.goes()
    scene.tell("", "lost", kind="control")
    scene.tell("goals", "they go on", kind="control")
    assert scene.comes() == ["lost", "goals they go on", "that is all"]
    scene.goes()
    assert "lost" in scene.comes()
    scene.proves()
    scene.goes()
    assert scene.comes() == ["goals they go on", "that is all"]


def test_a_daemon_that_is_away_when_it_has_heard_says_so_when_it_is_back() -> None:
    """Not into a link that is none."""
    scene = Scene()
    scene.comes()
    scene.goes()
    scene.now = HEARING_NS
    scene.memory.look()
    assert scene.takes() == []
    assert scene.comes() == ["that is all"]


def test_what_lasts_is_told_at_each_registration(scene: Scene) -> None:
    """Whether it has arrived or not."""
    scene.tell("arm")
    scene.proves()
    scene.tell("leg")
    assert scene.takes() == ["arm broken", "leg broken"]
    scene.goes()
    assert scene.comes() == ["arm broken", "leg broken", "that is all"]
    scene.goes()
    assert scene.comes() == ["arm broken", "leg broken", "that is all"]


def test_what_was_said_into_a_dead_link_is_said_again(scene: Scene) -> None:
    """That something is over, and words that have no end; of what has arrived only what lasts."""
    scene.tell("arm")
    scene.tell("", "look", kind="")
    scene.proves()
    scene.tell("arm", over=True)
    scene.tell("", "look again", kind="")
    scene.takes()
    scene.goes()
    assert scene.comes() == ["arm over", "look again", "that is all"]
    scene.proves()
    scene.goes()
    assert scene.comes() == ["that is all"]


def test_what_began_and_is_over_is_not_told_as_if_it_began_again(scene: Scene) -> None:
    """Unless nobody can have heard of it."""
    scene.tell("arm")
    scene.takes()
    scene.goes()
    scene.tell("arm", over=True)
    scene.tell("leg")
    scene.tell("leg", over=True)
    assert scene.takes() == []
    assert scene.comes() == ["arm over", "leg broken", "leg over", "that is all"]


def test_what_is_remembered_is_bounded_and_who_forgot_does_not_say_that_is_all(scene: Scene) -> None:
    """Else the relay would take for over what still lasts."""
    for each in range(KEPT + 1):
        scene.tell(f"part {each}")
    scene.proves()
    assert len(scene.takes()) == KEPT + 1
    scene.goes()
    told = scene.comes()
    assert len(told) == KEPT
    assert "that is all" not in told
    for each in range(KEPT + 1):
        scene.tell(f"part {each}", over=True)
    scene.proves()
    scene.goes()
    scene.takes()
    assert scene.comes() == ["that is all"]


def test_more_words_than_can_be_kept_push_out_none_that_last(scene: Scene) -> None:
    """Of a robot that is away for long."""
    scene.tell("arm")
    scene.goes()
    for each in range(2 * KEPT):
        scene.tell("", f"word {each}", kind="")
    scene.takes()
    told = scene.comes()
    assert told[0] == "arm broken"
    assert told[1:] == [f"word {each}" for each in range(KEPT, 2 * KEPT)] + ["that is all"]
