"""Who may move the robot: stop, suppression, holder, and letting go."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol import link
from robot_client.motion import authority as module
from robot_client.motion.authority import LET_GO, SETTLED, Authority, Suppression, Verdict

MS = 1_000_000
ANN, BEN, EVE = 1, 2, 3
WHEELS, ARM = "/cmd_vel", "/arm"
STOP = link.Stopped(by="eve", since=1.0)


class Scene:
    def __init__(self) -> None:
        self.now = 1000 * MS
        self.authority = Authority()

    def wait(self, ms: int) -> None:
        self.now += ms * MS

    def hold(self, holder: int, user: str = "") -> bool:
        return self.authority.hold(holder, user or f"user {holder}", "operator", self.now)

    def stop(self) -> None:
        self.authority.stop(STOP, self.now)

    def resume(self) -> None:
        self.authority.resume(self.now)

    def suppress(self, *sources: int, ms: int = 100, topic: str = WHEELS) -> bool:
        return self.authority.suppress(topic, Suppression(frozenset(sources), self.now + ms * MS, "x"))

    def go(self, source: int, topic: str = WHEELS, late: int = 0) -> Verdict:
        return self.authority.judge(source, topic, True, self.now, self.now - late * MS)

    def zero(self, source: int, topic: str = WHEELS) -> Verdict:
        return self.authority.judge(source, topic, False, self.now, self.now)

    def stream(self, source: int, ms: int, every: int = 50) -> list[Verdict]:
        said = []
        for _ in range(0, ms, every):
            self.wait(every)
            said.append(self.go(source))
        return said


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_only_the_holder_moves(scene: Scene) -> None:
    """At first nobody does; then who holds control, and what others say is counted."""
    assert scene.go(ANN) is Verdict.NOT_HOLDER
    scene.hold(ANN)
    assert scene.go(ANN) is Verdict.ALLOWED
    assert scene.go(BEN) is Verdict.NOT_HOLDER
    assert scene.zero(BEN) is Verdict.NOT_HOLDER
    assert scene.authority.refused == 3


def test_nobody_is_no_source(scene: Scene) -> None:
    """Source 0 moves nothing, also while nobody holds control."""
    assert scene.go(0) is Verdict.NOT_HOLDER
    assert scene.authority.judge_request(0, scene.now, scene.now) is Verdict.NOT_HOLDER


def test_who_takes_a_free_robot_by_commanding_moves_at_once(scene: Scene) -> None:
    """A program that began while nobody held control is obeyed from the moment it has it."""
    assert set(scene.stream(ANN, 300)) == {Verdict.NOT_HOLDER}
    scene.hold(ANN)
    scene.wait(5)
    assert scene.go(ANN) is Verdict.ALLOWED


def test_who_was_commanding_against_the_holder_lets_go_first(scene: Scene) -> None:
    """Given control, his stream is not obeyed until he pauses for half a second."""
    scene.hold(ANN)
    scene.stream(BEN, 300)
    scene.hold(BEN)
    assert set(scene.stream(BEN, 3000)) == {Verdict.NOT_LET_GO}
    scene.wait(499)
    assert scene.go(BEN) is Verdict.NOT_LET_GO
    scene.wait(500)
    assert scene.go(BEN) is Verdict.ALLOWED


def test_zero_is_letting_go(scene: Scene) -> None:
    """One command of zero on the topic, and the next is obeyed; on another topic it says nothing."""
    scene.hold(ANN)
    scene.go(BEN)
    scene.hold(BEN)
    scene.zero(BEN, ARM)
    assert scene.go(BEN) is Verdict.NOT_LET_GO
    assert scene.zero(BEN) is Verdict.ALLOWED
    assert scene.go(BEN) is Verdict.ALLOWED


def test_who_lost_control_while_moving_lets_go_before_he_has_it_again(scene: Scene) -> None:
    """Control taken away and given back does not let the same stream go on."""
    scene.hold(ANN)
    scene.stream(ANN, 200)
    scene.hold(0)
    assert set(scene.stream(ANN, 200)) == {Verdict.NOT_HOLDER}
    scene.hold(ANN)
    assert set(scene.stream(ANN, 700)) == {Verdict.NOT_LET_GO}


def test_stop_beats_the_holder_and_whoever_suppresses(scene: Scene) -> None:
    """Nobody moves anything while the robot is stopped, and the first who stopped it is remembered."""
    scene.hold(ANN)
    scene.suppress(BEN, ms=200)
    scene.stop()
    scene.authority.stop(link.Stopped(by="ann", since=2.0), scene.now)
    assert scene.go(BEN) is Verdict.STOPPED
    assert scene.go(ANN, ARM) is Verdict.STOPPED
    assert scene.zero(ANN) is Verdict.STOPPED
    assert scene.authority.judge_request(ANN, scene.now, scene.now) is Verdict.STOPPED
    assert scene.authority.stopped == STOP


def test_resume_moves_nothing(scene: Scene) -> None:
    """Who was commanding when the stop came, or went on during it, is not obeyed until he lets go."""
    scene.hold(ANN)
    scene.stream(ANN, 200)
    scene.stop()
    scene.stream(ANN, 1000)
    scene.resume()
    assert set(scene.stream(ANN, 2000)) == {Verdict.NOT_LET_GO}
    scene.wait(LET_GO // MS)
    assert scene.go(ANN) is Verdict.ALLOWED


def test_silence_during_a_stop_is_not_trusted(scene: Scene) -> None:
    """What a stream said meanwhile may have been kept back on its way: it counts from the resume on."""
    scene.hold(ANN)
    scene.stream(ANN, 200)
    scene.stop()
    scene.wait(5000)
    scene.resume()
    assert set(scene.stream(ANN, 2000)) == {Verdict.NOT_LET_GO}


def test_the_holder_of_a_resume_lets_go_though_nothing_was_heard_of_him(scene: Scene) -> None:
    """He may have held his stick all the time; half a second of silence, or zero, frees him."""
    scene.hold(ANN)
    scene.stop()
    scene.wait(5000)
    scene.resume()
    scene.wait(100)
    assert scene.go(ANN) is Verdict.NOT_LET_GO
    assert scene.zero(ANN) is Verdict.ALLOWED
    assert scene.go(ANN) is Verdict.ALLOWED
    assert scene.go(ANN, ARM) is Verdict.NOT_LET_GO


def test_zero_during_the_stop_is_letting_go(scene: Scene) -> None:
    """A hand that left the stick while the robot was stopped may take it again at once."""
    scene.hold(ANN)
    scene.go(ANN)
    scene.stop()
    scene.zero(ANN)
    scene.wait(5000)
    scene.resume()
    assert scene.go(ANN) is Verdict.ALLOWED


def test_who_comes_after_the_resume_moves_at_once(scene: Scene) -> None:
    """A source that was not there before has nothing to let go."""
    scene.hold(ANN)
    scene.stop()
    scene.resume()
    scene.hold(BEN)
    assert scene.go(BEN) is Verdict.ALLOWED


# --- what was sent before ----------------------------------------------------------------------------------


def requests(scene: Scene, late: int, source: int = ANN) -> Verdict:
    """What becomes of a goal that can have been sent so many milliseconds ago."""
    return scene.authority.judge_request(source, scene.now, scene.now - late * MS)


def test_what_was_sent_before_a_stop_is_not_obeyed_after_the_resume(scene: Scene) -> None:
    """A goal that was held up meanwhile; nor one of the time in which the robot was stopped. What comes after is."""
    scene.hold(ANN)
    scene.wait(100)
    scene.stop()
    scene.wait(200)
    scene.resume()
    scene.wait(100)
    assert requests(scene, 400) is Verdict.OVERTAKEN
    assert requests(scene, 101) is Verdict.OVERTAKEN
    assert scene.authority.refused == 2
    assert requests(scene, 100) is Verdict.ALLOWED


def test_a_link_that_stalls_makes_no_silence(scene: Scene) -> None:
    """However long nothing came of who must let go: what counts is when it can have been sent."""
    scene.hold(ANN)
    scene.stream(ANN, 200)
    scene.stop()
    scene.wait(200)
    scene.resume()
    scene.wait(700)
    assert scene.go(ANN, late=1000) is Verdict.NOT_LET_GO
    assert scene.go(ANN, late=500) is Verdict.NOT_LET_GO
    assert set(scene.stream(ANN, 300)) == {Verdict.NOT_LET_GO}
    scene.wait(700)
    assert scene.go(ANN, late=201) is Verdict.NOT_LET_GO
    scene.wait(700)
    assert scene.go(ANN, late=200) is Verdict.ALLOWED


def test_who_took_the_stick_before_the_resume_must_let_go_of_it(scene: Scene) -> None:
    """Though he had said zero before that, and the link told of it only after the resume."""
    scene.hold(ANN)
    scene.stop()
    scene.zero(ANN)
    scene.wait(1000)
    scene.resume()
    scene.wait(100)
    assert scene.go(ANN, late=500) is Verdict.NOT_LET_GO
    assert set(scene.stream(ANN, 1000)) == {Verdict.NOT_LET_GO}


def test_who_lets_go_and_drives_right_after_the_resume_is_obeyed_soon(scene: Scene) -> None:
    """Pings leave it in doubt for a moment whether he waited for it: that bars nobody."""
    scene.hold(ANN)
    scene.stop()
    scene.zero(ANN)
    scene.wait(1000)
    scene.resume()
    said = []
    for _ in range(5):
        scene.wait(50)
        said.append(scene.go(ANN, late=150))
    assert said == 2 * [Verdict.OVERTAKEN] + 3 * [Verdict.ALLOWED]


def test_zero_is_obeyed_whenever_it_was_sent(scene: Scene) -> None:
    """It moves nothing."""
    scene.hold(ANN)
    scene.stop()
    scene.resume()
    assert scene.authority.judge(ANN, WHEELS, False, scene.now, scene.now - 400 * MS) is Verdict.ALLOWED


def test_what_takes_a_free_robot_was_sent_before_control_came(scene: Scene) -> None:
    """The command, call or goal that made the relay ask for control is obeyed when it is there."""
    scene.wait(300)
    scene.hold(ANN)
    assert scene.go(ANN, late=200) is Verdict.ALLOWED
    assert requests(scene, 200) is Verdict.ALLOWED


def test_what_was_sent_before_control_was_lost_is_not_obeyed_when_it_is_back(scene: Scene) -> None:
    """It is of another time; who lost no control is not held up by that."""
    scene.hold(ANN)
    scene.wait(400)
    scene.hold(BEN)
    scene.wait(100)
    assert requests(scene, 400, BEN) is Verdict.ALLOWED
    scene.hold(ANN)
    scene.wait(100)
    assert requests(scene, 201) is Verdict.OVERTAKEN
    assert scene.go(ANN, late=201) is Verdict.OVERTAKEN
    assert requests(scene, 200) is Verdict.ALLOWED


def test_what_was_sent_before_the_link_was_lost_is_not_obeyed_by_the_new_one(scene: Scene) -> None:
    """Also of who is new to the robot, and waited in the relay."""
    lose(scene, 100)
    scene.wait(100)
    assert requests(scene, 201) is Verdict.OVERTAKEN
    assert scene.go(ANN, late=201) is Verdict.OVERTAKEN
    assert requests(scene, 200) is Verdict.ALLOWED


def test_same_holder_changes_only_the_level(scene: Scene) -> None:
    """Control given to who has it takes nothing from him."""
    scene.hold(ANN)
    scene.go(ANN)
    assert not scene.authority.hold(ANN, "ann", "owner", scene.now)
    assert scene.authority.level == "owner"
    assert scene.go(ANN) is Verdict.ALLOWED


def test_suppression_gives_a_topic_to_its_sources_for_its_time(scene: Scene) -> None:
    """They are obeyed without control, the holder is not; after it everything is as before, without letting go."""
    scene.hold(ANN)
    scene.go(ANN)
    scene.suppress(BEN, ms=100)
    assert scene.go(BEN) is Verdict.ALLOWED
    assert scene.go(ANN) is Verdict.SUPPRESSED
    assert scene.go(ANN, ARM) is Verdict.ALLOWED
    scene.wait(99)
    assert scene.go(ANN) is Verdict.SUPPRESSED
    scene.wait(1)
    assert scene.go(ANN) is Verdict.ALLOWED
    assert scene.go(BEN) is Verdict.NOT_HOLDER


def test_suppression_by_nobody_lets_nobody_move_the_topic(scene: Scene) -> None:
    """Without sources it holds everybody off."""
    scene.hold(ANN)
    scene.suppress()
    assert scene.go(ANN) is Verdict.SUPPRESSED


def test_nothing_that_moves_by_itself_begins_while_others_suppress(scene: Scene) -> None:
    """Goals and calls drive by publishers of the robot's own: of any topic, until the last suppression is over."""
    scene.hold(ANN)
    scene.suppress(BEN, ms=100)
    scene.suppress(EVE, ms=200, topic=ARM)
    assert requests(scene, 0) is Verdict.OVERRULED
    assert requests(scene, 0, BEN) is Verdict.NOT_HOLDER
    scene.wait(100)
    assert requests(scene, 0) is Verdict.OVERRULED
    scene.wait(100)
    assert requests(scene, 0) is Verdict.ALLOWED
    assert scene.authority.refused == 3


def test_a_holder_who_suppresses_gives_goals(scene: Scene) -> None:
    """He stands above himself; not beside others who suppress another topic, and never above a stop."""
    scene.hold(ANN)
    scene.suppress(ANN, BEN)
    assert requests(scene, 0) is Verdict.ALLOWED
    scene.suppress(BEN, topic=ARM)
    assert requests(scene, 0) is Verdict.OVERRULED
    scene.stop()
    assert requests(scene, 0) is Verdict.STOPPED


def test_who_suppresses_is_not_held_up_by_a_change_of_control(scene: Scene) -> None:
    """A program that keeps a robot from walls goes on when another takes control."""
    scene.hold(ANN)
    scene.go(BEN)
    scene.suppress(BEN, ms=200)
    assert scene.go(BEN) is Verdict.ALLOWED
    scene.hold(EVE)
    assert scene.go(BEN) is Verdict.ALLOWED


def test_suppressions_are_bounded(scene: Scene) -> None:
    """At most 64 topics; those there are can still be renewed."""
    for number in range(64):
        assert scene.suppress(ANN, topic=f"/t{number}")
    assert not scene.suppress(ANN, topic="/more")
    assert scene.suppress(ANN, topic="/t0")


def test_without_the_relay_nobody_holds_control_and_the_stop_stays(scene: Scene) -> None:
    """When the control link is gone its numbers mean nothing any more."""
    scene.hold(ANN)
    scene.suppress(BEN)
    scene.stop()
    scene.authority.forget(scene.now)
    assert (scene.authority.holder, scene.authority.level, scene.authority.suppressions) == (0, "", {})
    assert scene.authority.stopped == STOP


def lose(scene: Scene, ms: int) -> None:
    """The control link is away for a time."""
    scene.authority.forget(scene.now)
    scene.wait(ms)
    scene.authority.meet(scene.now)
    scene.hold(ANN)


@pytest.mark.parametrize("away", [10, 300, 600, 60_000])
@pytest.mark.parametrize("unheard", [0, 10_000])
def test_who_commands_on_through_a_lost_link_must_let_go_first(scene: Scene, away: int, unheard: int) -> None:
    """However long it was away, and also who was not heard for long before that."""
    scene.hold(ANN)
    scene.stream(ANN, 200)
    scene.wait(unheard)
    lose(scene, away)
    assert set(scene.stream(ANN, 2000)) == {Verdict.NOT_LET_GO}
    scene.wait(500)
    assert scene.go(ANN) is Verdict.ALLOWED


def test_who_is_new_after_a_lost_link_begins_at_once(scene: Scene) -> None:
    """Nobody's hand was on the stick: it is another connection."""
    scene.hold(BEN)
    scene.stream(BEN, 200)
    lose(scene, 300)
    assert scene.go(ANN) is Verdict.ALLOWED
    scene.hold(BEN)
    assert scene.go(BEN) is Verdict.NOT_LET_GO


@pytest.mark.parametrize("away", [10, 300, 60_000])
@pytest.mark.parametrize("graceful", [False, True])
@pytest.mark.parametrize("early", [False, True])
def test_who_comes_back_by_another_connection_must_let_go_first(
    scene: Scene, away: int, graceful: bool, early: bool
) -> None:
    """A relay that was started anew knows him by another number, and gives him control for his first command."""
    scene.hold(ANN, "ann")
    scene.stream(ANN, 200)
    if graceful:
        scene.authority.hold(0, "", "", scene.now)
    scene.authority.forget(scene.now)
    scene.wait(away)
    scene.authority.meet(scene.now)
    if early:
        scene.go(EVE)
    scene.hold(EVE, "ann")
    assert set(scene.stream(EVE, 7000)) == {Verdict.NOT_LET_GO}
    scene.wait(500)
    assert scene.go(EVE) is Verdict.ALLOWED


@pytest.mark.parametrize("by", ["zero", "silence"])
def test_who_has_let_go_since_he_came_back_need_not_by_his_next_connection(scene: Scene, by: str) -> None:
    """Of each topic by itself."""
    scene.hold(ANN, "ann")
    scene.go(ANN)
    scene.go(ANN, ARM)
    scene.authority.forget(scene.now)
    scene.authority.meet(scene.now)
    scene.hold(EVE, "ann")
    if by == "zero":
        scene.zero(EVE)
    else:
        assert scene.go(EVE) is Verdict.NOT_LET_GO
        scene.wait(500)
        assert scene.go(EVE) is Verdict.ALLOWED
    scene.hold(BEN, "ann")
    assert scene.go(BEN) is Verdict.ALLOWED
    assert scene.go(BEN, ARM) is Verdict.NOT_LET_GO


def test_who_comes_back_later_begins_at_once(scene: Scene) -> None:
    """After so long nobody takes it for the going on of anything."""
    scene.hold(ANN, "ann")
    scene.go(ANN)
    scene.authority.forget(scene.now)
    scene.authority.meet(scene.now)
    scene.wait(SETTLED // MS)
    scene.hold(EVE, "ann")
    assert scene.go(EVE) is Verdict.ALLOWED


def test_zero_is_letting_go_after_a_lost_link(scene: Scene) -> None:
    """Of its topic, also before control is given; and who begins long after it begins."""
    scene.hold(ANN)
    scene.go(ANN)
    scene.authority.forget(scene.now)
    scene.authority.meet(scene.now)
    scene.zero(ANN)
    scene.hold(ANN)
    assert scene.go(ANN) is Verdict.ALLOWED
    assert scene.go(ANN, ARM) is Verdict.NOT_LET_GO
    lose(scene, 300)
    scene.wait(SETTLED // MS)
    assert scene.go(ANN) is Verdict.ALLOWED


@pytest.mark.parametrize("heard_after", [499, 500, 4999])
@pytest.mark.parametrize("held_after", [0, 2000])
def test_stream_that_takes_time_to_be_heard_again_must_let_go(
    scene: Scene, heard_after: int, held_after: int
) -> None:
    """The channel comes after the control link, and control after that: what nobody could hear was no silence."""
    scene.hold(ANN)
    scene.stream(ANN, 200)
    scene.authority.forget(scene.now)
    scene.wait(1000)
    scene.authority.meet(scene.now)
    scene.wait(heard_after)
    scene.go(ANN)
    scene.stream(ANN, held_after)
    scene.hold(ANN)
    assert set(scene.stream(ANN, 1000)) == {Verdict.NOT_LET_GO}
    scene.wait(499)
    assert scene.go(ANN) is Verdict.NOT_LET_GO
    scene.wait(500)
    assert scene.go(ANN) is Verdict.ALLOWED


def test_link_that_is_lost_again_and_again_gives_nobody_an_opening(scene: Scene) -> None:
    """A source that was barred stays so until it has let go."""
    scene.hold(ANN)
    scene.go(ANN)
    for _ in range(5):
        lose(scene, 400)
        assert set(scene.stream(ANN, 300)) == {Verdict.NOT_LET_GO}
        scene.authority.forget(scene.now)
        scene.wait(700)
    lose(scene, 0)
    assert scene.go(ANN) is Verdict.NOT_LET_GO


def test_first_link_asks_nobody_to_let_go(scene: Scene) -> None:
    """There was nothing before it that could go on."""
    scene.authority.meet(scene.now)
    scene.hold(ANN)
    assert scene.go(ANN) is Verdict.ALLOWED


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> int:
    """Most that is remembered, so that tests come to its end soon."""
    monkeypatch.setattr(module, "GRIPS", 20)
    return 20


def test_however_many_come_little_is_remembered(scene: Scene, few: int) -> None:
    """Of those who command, hold control or let go, and of topics: of each kind so many, and no more."""
    largest: dict[str, int] = {}

    def look() -> None:
        for name, kept in vars(scene.authority).items():
            if isinstance(kept, (dict, set)) and name.startswith("_"):
                largest[name] = max(largest.get(name, 0), len(kept))

    for _ in range(2):
        for number in range(1, 2 * few):
            scene.hold(number)
            scene.zero(number)
            scene.go(number)
        for number in range(2 * few):
            scene.zero(2 * few - 1, f"/{number}")
        look()
        scene.authority.forget(scene.now)
        scene.authority.meet(scene.now)
        look()
    assert set(largest.values()) == {few}, largest


def test_however_many_sources_come_who_still_commands_is_remembered(scene: Scene, few: int) -> None:
    """More than that before him, at the same time, or before the link was lost twice, give him no opening."""
    others = range(100, 100 + few + 1)
    for source in others:
        scene.go(source)
    scene.go(ANN)
    lose(scene, 1000)
    scene.wait(1000)
    assert scene.go(ANN) is Verdict.NOT_LET_GO
    for source in others:
        scene.go(source)
        scene.go(ANN)
    assert scene.go(ANN) is Verdict.NOT_LET_GO
    lose(scene, 1000)
    scene.go(EVE)
    lose(scene, 1000)
    scene.wait(1000)
    assert scene.go(ANN) is Verdict.NOT_LET_GO


@given(st.lists(st.tuples(st.sampled_from("hsrzgzgggwfm"), st.integers(0, 3), st.integers(0, 600))))
def test_nobody_but_the_holder_is_ever_obeyed(steps: list[tuple[str, int, int]]) -> None:
    """Whatever happens in whatever order: who is obeyed holds control, and the robot is not stopped."""
    scene = Scene()
    for what, source, ms in steps:
        if what == "h":
            scene.hold(source)
        elif what == "s":
            scene.stop()
        elif what == "r":
            scene.resume()
        elif what == "w":
            scene.wait(ms)
        elif what == "f":
            scene.authority.forget(scene.now)
        elif what == "m":
            scene.authority.meet(scene.now)
        elif (scene.zero if what == "z" else scene.go)(source) is Verdict.ALLOWED:
            assert source == scene.authority.holder != 0
            assert scene.authority.stopped is None


@given(
    st.lists(
        st.tuples(st.sampled_from("hsrfmzggg"), st.integers(0, 3), st.integers(0, 600), st.integers(0, 3000)),
        max_size=60,
    )
)
def test_nothing_sent_before_a_stop_a_resume_or_a_lost_link_is_ever_obeyed(
    steps: list[tuple[str, int, int, int]],
) -> None:
    """Whatever happens in whatever order, and however long each was on its way."""
    scene = Scene()
    turned = 0
    for what, source, ms, late in steps:
        scene.wait(ms)
        if what == "h":
            scene.hold(source)
        elif what == "z":
            scene.zero(source)
        elif what == "g":
            for verdict in (scene.go(source, late=late), requests(scene, late, source)):
                assert verdict is not Verdict.ALLOWED or scene.now - late * MS >= turned
        elif what == "f":
            turned = turned if scene.authority._lost else scene.now
            scene.authority.forget(scene.now)
        elif what == "m":
            scene.authority.meet(scene.now)
        elif what == "s" or scene.authority.stopped is not None:
            turned = scene.now
            (scene.stop if what == "s" else scene.resume)()


@given(st.lists(st.tuples(st.sampled_from("hsrg"), st.integers(0, 3)), max_size=60))
def test_a_stream_through_a_stop_never_moves_again_by_itself(steps: list[tuple[str, int]]) -> None:
    """Who never lets go is not obeyed after a resume, whatever else happens, as long as he is heard often enough."""
    scene = Scene()
    scene.hold(ANN)
    scene.go(ANN)
    scene.stop()
    scene.resume()
    for what, source in steps:
        scene.wait(100)
        assert scene.go(ANN) is not Verdict.ALLOWED
        if what == "h":
            scene.hold(source)
        elif what == "s":
            scene.stop()
        elif what == "r":
            scene.resume()
        else:
            scene.go(source if source != ANN else BEN)


@given(st.lists(st.tuples(st.sampled_from("sr...."), st.integers(1, 20)), max_size=20))
def test_a_stream_through_a_stop_never_moves_again_however_its_link_stalls(
    steps: list[tuple[str, int]],
) -> None:
    """All that is held up comes in the end, and shows that nobody has let go."""
    scene = Scene()
    scene.hold(ANN)
    scene.go(ANN)
    scene.stop()
    scene.resume()
    held_up: list[int] = []
    for what, stalled in steps:
        for _ in range(stalled):
            scene.wait(100)
            held_up.append(scene.now)
        if what == "s":
            scene.stop()
        elif what == "r":
            scene.resume()
        else:
            for sent in held_up:
                assert scene.authority.judge(ANN, WHEELS, True, scene.now, sent) is not Verdict.ALLOWED
            held_up.clear()


@given(
    st.lists(
        st.tuples(
            st.sampled_from("hsrglll"), st.integers(0, 3), st.integers(0, 10_000), st.integers(0, 4800)
        ),
        max_size=40,
    )
)
def test_a_stream_through_lost_links_never_moves_again_by_itself(
    steps: list[tuple[str, int, int, int]],
) -> None:
    """However long each was away and however late he is heard by the new one, whoever has control meanwhile."""
    scene = Scene()
    scene.hold(ANN)
    scene.go(ANN)
    for what, source, away, late in [("l", ANN, 0, 0), *steps]:
        if what == "h":
            scene.hold(source)
        elif what == "s":
            scene.stop()
        elif what == "r":
            scene.resume()
        elif what == "l":
            lose(scene, away)
            scene.hold(source)
            scene.wait(late)
        else:
            scene.go(source if source != ANN else BEN)
        scene.wait(100)
        assert scene.go(ANN) is not Verdict.ALLOWED


@given(
    st.lists(st.tuples(st.sampled_from("hsrglw"), st.integers(1, 3), st.integers(0, 600)), max_size=40),
    st.booleans(),
)
def test_who_lets_go_is_obeyed_whatever_was_before(
    steps: list[tuple[str, int, int]], says_zero: bool
) -> None:
    """After a zero, or one refused command and half a second of silence, nobody is barred who holds control."""
    scene = Scene()
    for what, source, ms in steps:
        if what == "h":
            scene.hold(source)
        elif what == "s":
            scene.stop()
        elif what == "r":
            scene.resume()
        elif what == "l":
            lose(scene, ms)
        elif what == "w":
            scene.wait(ms)
        else:
            scene.go(source)
    scene.resume()
    scene.hold(ANN)
    if says_zero:
        scene.zero(ANN)
    else:
        scene.go(ANN)
        scene.wait(LET_GO // MS)
    assert scene.go(ANN) is Verdict.ALLOWED
