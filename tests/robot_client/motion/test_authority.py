"""Which source may move the robot: stop, suppression, holder, and release of the controls."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol import link
from relay_protocol.release_rule import RECONNECT_NS, RELEASE_NS, CommandStreams
from robot_client.motion.authority import Authority, MotionDecision, Suppression

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
        return self.authority.grant_control(holder, user or f"user {holder}", "operator", self.now)

    def stop(self) -> None:
        self.authority.stop(STOP, self.now)

    def resume(self) -> None:
        self.authority.resume(self.now)

    def suppress(self, *sources: int, ms: int = 100, topic: str = WHEELS) -> bool:
        return self.authority.suppress(topic, Suppression(frozenset(sources), self.now + ms * MS, "x"))

    def go(self, source: int, topic: str = WHEELS, late: int = 0) -> MotionDecision:
        return self.authority.decide(source, topic, True, self.now, self.now - late * MS)

    def zero(self, source: int, topic: str = WHEELS) -> MotionDecision:
        return self.authority.decide(source, topic, False, self.now, self.now)

    def stream(self, source: int, ms: int, every: int = 50) -> list[MotionDecision]:
        said = []
        for _ in range(0, ms, every):
            self.wait(every)
            said.append(self.go(source))
        return said


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_only_the_holder_is_obeyed(scene: Scene) -> None:
    """Refused commands are counted."""
    assert scene.go(ANN) is MotionDecision.NOT_HOLDER
    scene.hold(ANN)
    assert scene.go(ANN) is MotionDecision.ALLOWED
    assert scene.go(BEN) is MotionDecision.NOT_HOLDER
    assert scene.zero(BEN) is MotionDecision.NOT_HOLDER
    assert scene.authority.refused == 3


def test_source_0_is_never_obeyed(scene: Scene) -> None:
    assert scene.go(0) is MotionDecision.NOT_HOLDER
    assert scene.authority.decide_request(0, scene.now, scene.now) is MotionDecision.NOT_HOLDER


def test_stream_that_began_while_the_robot_was_free_needs_no_release(scene: Scene) -> None:
    assert set(scene.stream(ANN, 300)) == {MotionDecision.NOT_HOLDER}
    scene.hold(ANN)
    scene.wait(5)
    assert scene.go(ANN) is MotionDecision.ALLOWED


def test_stream_that_commanded_against_a_holder_must_release(scene: Scene) -> None:
    """Half a second of silence releases it."""
    scene.hold(ANN)
    scene.stream(BEN, 300)
    scene.hold(BEN)
    assert set(scene.stream(BEN, 3000)) == {MotionDecision.MUST_RELEASE}
    scene.wait(499)
    assert scene.go(BEN) is MotionDecision.MUST_RELEASE
    scene.wait(500)
    assert scene.go(BEN) is MotionDecision.ALLOWED


def test_zero_releases_its_own_topic(scene: Scene) -> None:
    scene.hold(ANN)
    scene.go(BEN)
    scene.hold(BEN)
    scene.zero(BEN, ARM)
    assert scene.go(BEN) is MotionDecision.MUST_RELEASE
    assert scene.zero(BEN) is MotionDecision.ALLOWED
    assert scene.go(BEN) is MotionDecision.ALLOWED


def test_stream_must_release_after_control_was_lost(scene: Scene) -> None:
    scene.hold(ANN)
    scene.stream(ANN, 200)
    scene.hold(0)
    assert set(scene.stream(ANN, 200)) == {MotionDecision.NOT_HOLDER}
    scene.hold(ANN)
    assert set(scene.stream(ANN, 700)) == {MotionDecision.MUST_RELEASE}


def test_stop_refuses_holder_and_suppressing_sources(scene: Scene) -> None:
    """The first stop stays recorded."""
    scene.hold(ANN)
    scene.suppress(BEN, ms=200)
    scene.stop()
    scene.authority.stop(link.Stopped(by="ann", since=2.0), scene.now)
    assert scene.go(BEN) is MotionDecision.STOPPED
    assert scene.go(ANN, ARM) is MotionDecision.STOPPED
    assert scene.zero(ANN) is MotionDecision.STOPPED
    assert scene.authority.decide_request(ANN, scene.now, scene.now) is MotionDecision.STOPPED
    assert scene.authority.stopped == STOP


def test_streams_must_release_after_a_resume(scene: Scene) -> None:
    """Whether they began before or during the stop."""
    scene.hold(ANN)
    scene.stream(ANN, 200)
    scene.stop()
    scene.stream(ANN, 1000)
    scene.resume()
    assert set(scene.stream(ANN, 2000)) == {MotionDecision.MUST_RELEASE}
    scene.wait(RELEASE_NS // MS)
    assert scene.go(ANN) is MotionDecision.ALLOWED


def test_silence_counts_from_the_resume(scene: Scene) -> None:
    """Commands sent during the stop may still arrive."""
    scene.hold(ANN)
    scene.stream(ANN, 200)
    scene.stop()
    scene.wait(5000)
    scene.resume()
    assert set(scene.stream(ANN, 2000)) == {MotionDecision.MUST_RELEASE}


def test_holder_at_the_resume_must_release_without_earlier_commands(scene: Scene) -> None:
    """Its earlier commands may not have arrived."""
    scene.hold(ANN)
    scene.stop()
    scene.wait(5000)
    scene.resume()
    scene.wait(100)
    assert scene.go(ANN) is MotionDecision.MUST_RELEASE
    assert scene.zero(ANN) is MotionDecision.ALLOWED
    assert scene.go(ANN) is MotionDecision.ALLOWED
    assert scene.go(ANN, ARM) is MotionDecision.MUST_RELEASE


def test_zero_during_the_stop_releases(scene: Scene) -> None:
    scene.hold(ANN)
    scene.go(ANN)
    scene.stop()
    scene.zero(ANN)
    scene.wait(5000)
    scene.resume()
    assert scene.go(ANN) is MotionDecision.ALLOWED


def test_source_that_is_new_after_the_resume_needs_no_release(scene: Scene) -> None:
    scene.hold(ANN)
    scene.stop()
    scene.resume()
    scene.hold(BEN)
    assert scene.go(BEN) is MotionDecision.ALLOWED


# --- what was sent before ----------------------------------------------------------------------------------


def requests(scene: Scene, late: int, source: int = ANN) -> MotionDecision:
    """Judge a goal that can have been sent so many milliseconds ago."""
    return scene.authority.decide_request(source, scene.now, scene.now - late * MS)


def test_requests_sent_before_or_during_a_stop_are_stale_after_the_resume(scene: Scene) -> None:
    scene.hold(ANN)
    scene.wait(100)
    scene.stop()
    scene.wait(200)
    scene.resume()
    scene.wait(100)
    assert requests(scene, 400) is MotionDecision.STALE
    assert requests(scene, 101) is MotionDecision.STALE
    assert scene.authority.refused == 2
    assert requests(scene, 100) is MotionDecision.ALLOWED


def test_silence_counts_by_the_time_of_sending(scene: Scene) -> None:
    scene.hold(ANN)
    scene.stream(ANN, 200)
    scene.stop()
    scene.wait(200)
    scene.resume()
    scene.wait(700)
    assert scene.go(ANN, late=1000) is MotionDecision.MUST_RELEASE
    assert scene.go(ANN, late=500) is MotionDecision.MUST_RELEASE
    assert set(scene.stream(ANN, 300)) == {MotionDecision.MUST_RELEASE}
    scene.wait(700)
    assert scene.go(ANN, late=201) is MotionDecision.MUST_RELEASE
    scene.wait(700)
    assert scene.go(ANN, late=200) is MotionDecision.ALLOWED


def test_stream_that_began_before_the_resume_must_release(scene: Scene) -> None:
    """Although it was zero before, and arrived after the resume."""
    scene.hold(ANN)
    scene.stop()
    scene.zero(ANN)
    scene.wait(1000)
    scene.resume()
    scene.wait(100)
    assert scene.go(ANN, late=500) is MotionDecision.MUST_RELEASE
    assert set(scene.stream(ANN, 1000)) == {MotionDecision.MUST_RELEASE}


def test_tolerance_of_pings_delays_a_released_stream_only_briefly(scene: Scene) -> None:
    scene.hold(ANN)
    scene.stop()
    scene.zero(ANN)
    scene.wait(1000)
    scene.resume()
    said = []
    for _ in range(5):
        scene.wait(50)
        said.append(scene.go(ANN, late=150))
    assert said == 2 * [MotionDecision.STALE] + 3 * [MotionDecision.ALLOWED]


def test_zero_is_never_stale(scene: Scene) -> None:
    scene.hold(ANN)
    scene.stop()
    scene.resume()
    assert (
        scene.authority.decide(ANN, WHEELS, False, scene.now, scene.now - 400 * MS) is MotionDecision.ALLOWED
    )


def test_command_that_acquires_a_free_robot_is_not_stale(scene: Scene) -> None:
    """Nor a call or goal: it was sent before control was granted."""
    scene.wait(300)
    scene.hold(ANN)
    assert scene.go(ANN, late=200) is MotionDecision.ALLOWED
    assert requests(scene, 200) is MotionDecision.ALLOWED


def test_commands_sent_before_control_was_lost_are_stale_when_it_is_back(scene: Scene) -> None:
    """Other sources are not affected."""
    scene.hold(ANN)
    scene.wait(400)
    scene.hold(BEN)
    scene.wait(100)
    assert requests(scene, 400, BEN) is MotionDecision.ALLOWED
    scene.hold(ANN)
    scene.wait(100)
    assert requests(scene, 201) is MotionDecision.STALE
    assert scene.go(ANN, late=201) is MotionDecision.STALE
    assert requests(scene, 200) is MotionDecision.ALLOWED


def test_commands_sent_before_the_link_was_lost_are_stale(scene: Scene) -> None:
    """Also those of a source that is new to the robot."""
    lose(scene, 100)
    scene.wait(100)
    assert requests(scene, 201) is MotionDecision.STALE
    assert scene.go(ANN, late=201) is MotionDecision.STALE
    assert requests(scene, 200) is MotionDecision.ALLOWED


def test_grant_to_the_holder_changes_only_the_level(scene: Scene) -> None:
    scene.hold(ANN)
    scene.go(ANN)
    assert not scene.authority.grant_control(ANN, "ann", "owner", scene.now)
    assert scene.authority.level == "owner"
    assert scene.go(ANN) is MotionDecision.ALLOWED


def test_suppression_admits_only_its_sources_for_its_time(scene: Scene) -> None:
    """They need no control; afterwards the holder needs no release."""
    scene.hold(ANN)
    scene.go(ANN)
    scene.suppress(BEN, ms=100)
    assert scene.go(BEN) is MotionDecision.ALLOWED
    assert scene.go(ANN) is MotionDecision.SUPPRESSED
    assert scene.go(ANN, ARM) is MotionDecision.ALLOWED
    scene.wait(99)
    assert scene.go(ANN) is MotionDecision.SUPPRESSED
    scene.wait(1)
    assert scene.go(ANN) is MotionDecision.ALLOWED
    assert scene.go(BEN) is MotionDecision.NOT_HOLDER


def test_suppression_without_sources_admits_none(scene: Scene) -> None:
    scene.hold(ANN)
    scene.suppress()
    assert scene.go(ANN) is MotionDecision.SUPPRESSED


def test_no_goal_or_call_begins_while_other_sources_suppress_a_topic(scene: Scene) -> None:
    """Of any topic, until the last suppression has ended."""
    scene.hold(ANN)
    scene.suppress(BEN, ms=100)
    scene.suppress(EVE, ms=200, topic=ARM)
    assert requests(scene, 0) is MotionDecision.SUPPRESSED_ELSEWHERE
    assert requests(scene, 0, BEN) is MotionDecision.NOT_HOLDER
    scene.wait(100)
    assert requests(scene, 0) is MotionDecision.SUPPRESSED_ELSEWHERE
    scene.wait(100)
    assert requests(scene, 0) is MotionDecision.ALLOWED
    assert scene.authority.refused == 3


def test_holder_that_suppresses_may_send_goals(scene: Scene) -> None:
    """Not while others suppress another topic, and not during a stop."""
    scene.hold(ANN)
    scene.suppress(ANN, BEN)
    assert requests(scene, 0) is MotionDecision.ALLOWED
    scene.suppress(BEN, topic=ARM)
    assert requests(scene, 0) is MotionDecision.SUPPRESSED_ELSEWHERE
    scene.stop()
    assert requests(scene, 0) is MotionDecision.STOPPED


def test_suppressing_source_is_not_affected_by_a_change_of_control(scene: Scene) -> None:
    scene.hold(ANN)
    scene.go(BEN)
    scene.suppress(BEN, ms=200)
    assert scene.go(BEN) is MotionDecision.ALLOWED
    scene.hold(EVE)
    assert scene.go(BEN) is MotionDecision.ALLOWED


def test_suppressions_are_bounded(scene: Scene) -> None:
    """At most 64 topics; existing ones can be renewed."""
    for number in range(64):
        assert scene.suppress(ANN, topic=f"/t{number}")
    assert not scene.suppress(ANN, topic="/more")
    assert scene.suppress(ANN, topic="/t0")


def test_lost_link_ends_control_but_not_a_stop(scene: Scene) -> None:
    scene.hold(ANN)
    scene.suppress(BEN)
    scene.stop()
    scene.authority.link_lost(scene.now)
    assert (scene.authority.holder, scene.authority.level, scene.authority.suppressions) == (0, "", {})
    assert scene.authority.stopped == STOP


def lose(scene: Scene, ms: int) -> None:
    """Lose the control link for a time."""
    scene.authority.link_lost(scene.now)
    scene.wait(ms)
    scene.authority.link_restored(scene.now)
    scene.hold(ANN)


@pytest.mark.parametrize("away", [10, 300, 600, 60_000])
@pytest.mark.parametrize("unheard", [0, 10_000])
def test_stream_must_release_after_a_lost_link(scene: Scene, away: int, unheard: int) -> None:
    """However long the link was lost."""
    scene.hold(ANN)
    scene.stream(ANN, 200)
    scene.wait(unheard)
    lose(scene, away)
    assert set(scene.stream(ANN, 2000)) == {MotionDecision.MUST_RELEASE}
    scene.wait(500)
    assert scene.go(ANN) is MotionDecision.ALLOWED


def test_source_and_user_that_are_new_after_a_lost_link_need_no_release(scene: Scene) -> None:
    scene.hold(BEN)
    scene.stream(BEN, 200)
    lose(scene, 300)
    assert scene.go(ANN) is MotionDecision.ALLOWED
    scene.hold(BEN)
    assert scene.go(BEN) is MotionDecision.MUST_RELEASE


@pytest.mark.parametrize("away", [10, 300, 60_000])
@pytest.mark.parametrize("graceful", [False, True])
@pytest.mark.parametrize("early", [False, True])
def test_user_that_returns_by_another_connection_must_release(
    scene: Scene, away: int, graceful: bool, early: bool
) -> None:
    """A restarted relay numbers connections again."""
    scene.hold(ANN, "ann")
    scene.stream(ANN, 200)
    if graceful:
        scene.authority.grant_control(0, "", "", scene.now)
    scene.authority.link_lost(scene.now)
    scene.wait(away)
    scene.authority.link_restored(scene.now)
    if early:
        scene.go(EVE)
    scene.hold(EVE, "ann")
    assert set(scene.stream(EVE, 7000)) == {MotionDecision.MUST_RELEASE}
    scene.wait(500)
    assert scene.go(EVE) is MotionDecision.ALLOWED


@pytest.mark.parametrize("by", ["zero", "silence"])
def test_released_user_need_not_release_again_by_the_next_connection(scene: Scene, by: str) -> None:
    """For each topic."""
    scene.hold(ANN, "ann")
    scene.go(ANN)
    scene.go(ANN, ARM)
    scene.authority.link_lost(scene.now)
    scene.authority.link_restored(scene.now)
    scene.hold(EVE, "ann")
    if by == "zero":
        scene.zero(EVE)
    else:
        assert scene.go(EVE) is MotionDecision.MUST_RELEASE
        scene.wait(500)
        assert scene.go(EVE) is MotionDecision.ALLOWED
    scene.hold(BEN, "ann")
    assert scene.go(BEN) is MotionDecision.ALLOWED
    assert scene.go(BEN, ARM) is MotionDecision.MUST_RELEASE


def test_user_that_returns_later_needs_no_release(scene: Scene) -> None:
    scene.hold(ANN, "ann")
    scene.go(ANN)
    scene.authority.link_lost(scene.now)
    scene.authority.link_restored(scene.now)
    scene.wait(RECONNECT_NS // MS)
    scene.hold(EVE, "ann")
    assert scene.go(EVE) is MotionDecision.ALLOWED


def test_zero_releases_its_topic_after_a_lost_link(scene: Scene) -> None:
    """Also before control is granted."""
    scene.hold(ANN)
    scene.go(ANN)
    scene.authority.link_lost(scene.now)
    scene.authority.link_restored(scene.now)
    scene.zero(ANN)
    scene.hold(ANN)
    assert scene.go(ANN) is MotionDecision.ALLOWED
    assert scene.go(ANN, ARM) is MotionDecision.MUST_RELEASE
    lose(scene, 300)
    scene.wait(RECONNECT_NS // MS)
    assert scene.go(ANN) is MotionDecision.ALLOWED


@pytest.mark.parametrize("heard_after", [499, 500, 4999])
@pytest.mark.parametrize("held_after", [0, 2000])
def test_silence_before_the_channel_is_restored_is_no_release(
    scene: Scene, heard_after: int, held_after: int
) -> None:
    """The channel is opened after the control link, and control is granted after that."""
    scene.hold(ANN)
    scene.stream(ANN, 200)
    scene.authority.link_lost(scene.now)
    scene.wait(1000)
    scene.authority.link_restored(scene.now)
    scene.wait(heard_after)
    scene.go(ANN)
    scene.stream(ANN, held_after)
    scene.hold(ANN)
    assert set(scene.stream(ANN, 1000)) == {MotionDecision.MUST_RELEASE}
    scene.wait(499)
    assert scene.go(ANN) is MotionDecision.MUST_RELEASE
    scene.wait(500)
    assert scene.go(ANN) is MotionDecision.ALLOWED


def test_repeated_loss_of_the_link_does_not_lift_the_release_rule(scene: Scene) -> None:
    scene.hold(ANN)
    scene.go(ANN)
    for _ in range(5):
        lose(scene, 400)
        assert set(scene.stream(ANN, 300)) == {MotionDecision.MUST_RELEASE}
        scene.authority.link_lost(scene.now)
        scene.wait(700)
    lose(scene, 0)
    assert scene.go(ANN) is MotionDecision.MUST_RELEASE


def test_first_link_requires_no_release(scene: Scene) -> None:
    scene.authority.link_restored(scene.now)
    scene.hold(ANN)
    assert scene.go(ANN) is MotionDecision.ALLOWED


@pytest.fixture
def few(scene: Scene) -> int:
    """An authority with a small capacity, so that tests end soon."""
    scene.authority = Authority(capacity=20)
    return 20


def test_memory_is_bounded(scene: Scene, few: int) -> None:
    """For sources, holders, users and topics."""
    largest: dict[str, int] = {}

    def look() -> None:
        parts = {**vars(scene.authority), **vars(scene.authority._link_loss)}
        for name, kept in parts.items():
            if isinstance(kept, (dict, set, CommandStreams)) and name.startswith("_"):
                largest[name] = max(largest.get(name, 0), len(kept))

    for _ in range(2):
        for number in range(1, 2 * few):
            scene.hold(number)
            scene.zero(number)
            scene.go(number)
        for number in range(2 * few):
            scene.zero(2 * few - 1, f"/{number}")
        look()
        scene.authority.link_lost(scene.now)
        scene.authority.link_restored(scene.now)
        look()
    assert set(largest.values()) == {few}, largest


def test_streams_that_still_command_are_remembered_longest(scene: Scene, few: int) -> None:
    """However many sources come meanwhile."""
    others = range(100, 100 + few + 1)
    for source in others:
        scene.go(source)
    scene.go(ANN)
    lose(scene, 1000)
    scene.wait(1000)
    assert scene.go(ANN) is MotionDecision.MUST_RELEASE
    for source in others:
        scene.go(source)
        scene.go(ANN)
    assert scene.go(ANN) is MotionDecision.MUST_RELEASE
    lose(scene, 1000)
    scene.go(EVE)
    lose(scene, 1000)
    scene.wait(1000)
    assert scene.go(ANN) is MotionDecision.MUST_RELEASE


@given(st.lists(st.tuples(st.sampled_from("hsrzgzgggwfm"), st.integers(0, 3), st.integers(0, 600))))
def test_only_the_holder_is_obeyed_in_any_order_of_events(steps: list[tuple[str, int, int]]) -> None:
    """And never while the robot is stopped."""
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
            scene.authority.link_lost(scene.now)
        elif what == "m":
            scene.authority.link_restored(scene.now)
        elif (scene.zero if what == "z" else scene.go)(source) is MotionDecision.ALLOWED:
            assert source == scene.authority.holder != 0
            assert scene.authority.stopped is None


@given(
    st.lists(
        st.tuples(st.sampled_from("hsrfmzggg"), st.integers(0, 3), st.integers(0, 600), st.integers(0, 3000)),
        max_size=60,
    )
)
def test_requests_sent_before_an_interruption_are_refused_in_any_order_of_events(
    steps: list[tuple[str, int, int, int]],
) -> None:
    """For any delay of each."""
    scene = Scene()
    turned = -(1 << 62)
    for what, source, ms, late in steps:
        scene.wait(ms)
        if what == "h":
            scene.hold(source)
        elif what == "z":
            scene.zero(source)
        elif what == "g":
            for decision in (scene.go(source, late=late), requests(scene, late, source)):
                assert decision is not MotionDecision.ALLOWED or scene.now - late * MS >= turned
        elif what == "f":
            turned = turned if scene.authority.link_is_lost else scene.now
            scene.authority.link_lost(scene.now)
        elif what == "m":
            scene.authority.link_restored(scene.now)
        elif what == "s" or scene.authority.stopped is not None:
            turned = scene.now
            (scene.stop if what == "s" else scene.resume)()


@given(st.lists(st.tuples(st.sampled_from("hsrg"), st.integers(0, 3)), max_size=60))
def test_stream_through_a_stop_stays_refused_in_any_order_of_events(steps: list[tuple[str, int]]) -> None:
    """While it commands often enough."""
    scene = Scene()
    scene.hold(ANN)
    scene.go(ANN)
    scene.stop()
    scene.resume()
    for what, source in steps:
        scene.wait(100)
        assert scene.go(ANN) is not MotionDecision.ALLOWED
        if what == "h":
            scene.hold(source)
        elif what == "s":
            scene.stop()
        elif what == "r":
            scene.resume()
        else:
            scene.go(source if source != ANN else BEN)


@given(st.lists(st.tuples(st.sampled_from("sr...."), st.integers(1, 20)), max_size=20))
def test_stream_through_a_stop_stays_refused_however_its_link_stalls(
    steps: list[tuple[str, int]],
) -> None:
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
                assert (
                    scene.authority.decide(ANN, WHEELS, True, scene.now, sent) is not MotionDecision.ALLOWED
                )
            held_up.clear()


@given(
    st.lists(
        st.tuples(
            st.sampled_from("hsrglll"), st.integers(0, 3), st.integers(0, 10_000), st.integers(0, 4800)
        ),
        max_size=40,
    )
)
def test_stream_through_lost_links_stays_refused(
    steps: list[tuple[str, int, int, int]],
) -> None:
    """For any controller meanwhile."""
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
        assert scene.go(ANN) is not MotionDecision.ALLOWED


@given(
    st.lists(st.tuples(st.sampled_from("hsrglw"), st.integers(1, 3), st.integers(0, 600)), max_size=40),
    st.booleans(),
)
def test_released_holder_is_obeyed_after_any_events(
    steps: list[tuple[str, int, int]], says_zero: bool
) -> None:
    """After a zero, or one refused command and half a second of silence."""
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
        scene.wait(RELEASE_NS // MS)
    assert scene.go(ANN) is MotionDecision.ALLOWED
