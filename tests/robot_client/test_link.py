"""The robot links, bytes in and bytes out."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol import frames, identity, link
from relay_protocol.errors import FrameTooLarge, MalformedMessage, PeerError, SwitchboardError
from relay_protocol.limits import COMMAND_FRAME, HANDSHAKE_FRAME
from robot_client.link.protocol import (
    ChannelLink,
    ControlLink,
    EnrolledAt,
    EnrolmentLink,
    Identity,
    JoinedChannel,
    Link,
    LinkSilent,
    LinkState,
    MessageReceived,
    Registered,
    RelayRefused,
    SampleReceived,
    VideoLink,
    WrongRelay,
)

KEY = identity.generate_key()
ME = Identity("r1", "relay-1", KEY)
NONCE = bytes(range(32))


class Ticks:
    def __init__(self) -> None:
        self.now = 1_000_000_000

    def __call__(self) -> int:
        return self.now


@pytest.fixture
def ticks() -> Ticks:
    return Ticks()


def said(end: Link) -> list[dict[str, object]]:
    import json

    found = []
    for frame in frames.FrameDecoder(2**20).feed(b"".join(end.take())):
        found.append(json.loads(frame.body))
    return found


def challenged(ticks: Ticks, relay: str = "relay-1") -> ControlLink:
    end = ControlLink(ME, "test", ticks)
    end.begin()
    end.take()
    end.receive(link.frame(link.Challenge(nonce=link.to_base64(NONCE), relay=relay)))
    return end


def registered(ticks: Ticks) -> ControlLink:
    end = challenged(ticks)
    end.take()
    end.receive(link.frame(link.Welcome(session="s", heartbeat=2.0, frame_limit=2**24)))
    return end


def opened(ticks: Ticks) -> ChannelLink:
    end = ChannelLink("ticket", ticks, 2.0)
    end.begin()
    end.take()
    end.receive(link.frame(link.Joined(channel="c", at=5)))
    return end


def shown(ticks: Ticks) -> VideoLink:
    end = VideoLink("ticket", ticks, 2.0)
    end.begin()
    end.take()
    end.receive(link.frame(link.Joined(channel="s", at=5)))
    return end


def test_hello_names_key_and_encoding(ticks: Ticks) -> None:
    """The first word names the robot, the fingerprint of its key, and CDR."""
    end = ControlLink(ME, "test", ticks)
    end.begin()
    (hello,) = said(end)
    assert hello["op"] == "hello"
    assert hello["robot"] == "r1"
    assert hello["key"] == identity.fingerprint(identity.public_half(KEY))
    assert hello["encodings"] == ["cdr"]


def test_proof_is_for_this_challenge(ticks: Ticks) -> None:
    """The proof verifies for relay, robot and nonce of the challenge."""
    (prove,) = said(challenged(ticks))
    signature = link.from_base64(str(prove["signature"]), "signature")
    assert identity.verify(identity.public_half(KEY), "relay-1", "r1", NONCE, signature)


def test_other_relay_gets_no_signature(ticks: Ticks) -> None:
    """A relay with another name than at enrolment is refused, and nothing is signed for it."""
    end = ControlLink(ME, "test", ticks)
    end.begin()
    end.take()
    with pytest.raises(WrongRelay, match="enrolled at 'relay-1'"):
        end.receive(link.frame(link.Challenge(nonce=link.to_base64(NONCE), relay="evil")))
    assert end.take() == []


@pytest.mark.parametrize("nonce", [b"", bytes(31), bytes(33)])
def test_short_nonce_is_not_signed(ticks: Ticks, nonce: bytes) -> None:
    """A nonce of another length than agreed is refused."""
    end = ControlLink(ME, "test", ticks)
    with pytest.raises(MalformedMessage):
        end.receive(link.frame(link.Challenge(nonce=link.to_base64(nonce), relay="relay-1")))


def test_welcome_registers(ticks: Ticks) -> None:
    """After the welcome the link takes orders and larger frames."""
    end = challenged(ticks)
    (event,) = end.receive(link.frame(link.Welcome(session="s", heartbeat=3.0, frame_limit=9)))
    assert isinstance(event, Registered)
    assert end.heartbeat == 3.0
    (order,) = end.receive(link.frame(link.OpenChannel(channel="c", ticket="t")))
    assert order == MessageReceived(link.OpenChannel(channel="c", ticket="t"))


def test_registered_link_takes_orders_for_video(ticks: Ticks) -> None:
    """Streams are opened and closed like channels."""
    orders = [
        link.OpenVideo(stream="s", ticket="t", camera="/c", settings=link.VideoSettings(width=3)),
        link.CloseVideo(stream="s"),
    ]
    assert registered(ticks).receive(b"".join(map(link.frame, orders))) == [
        MessageReceived(each) for each in orders
    ]


def test_welcome_before_proof_is_an_error(ticks: Ticks) -> None:
    """A relay that welcomes without a challenge is not trusted."""
    end = ControlLink(ME, "test", ticks)
    with pytest.raises(MalformedMessage, match="welcome"):
        end.receive(link.frame(link.Welcome(session="s", heartbeat=2.0, frame_limit=9)))


def test_refusal_keeps_its_reason(ticks: Ticks) -> None:
    """What the relay says when it refuses reaches the log, and when to come back the backoff."""
    end = ControlLink(ME, "test", ticks)
    with pytest.raises(RelayRefused, match="no such robot") as caught:
        end.receive(link.frame(link.Refused(reason="no such robot", retry_after=7)))
    assert caught.value.retry_after == 7


@pytest.mark.parametrize("size", [HANDSHAKE_FRAME + 1, 2**32 - 1])
def test_large_frames_are_refused_before_registration(ticks: Ticks, size: int) -> None:
    """Before the relay has shown who it is, a frame over 16 KiB is refused by its length alone."""
    end = ControlLink(ME, "test", ticks)
    with pytest.raises(FrameTooLarge):
        end.receive(size.to_bytes(4, "big"))


def test_limit_grows_with_registration(ticks: Ticks) -> None:
    """A registered link takes frames up to the command limit and none larger."""
    end = registered(ticks)
    end.receive(COMMAND_FRAME.to_bytes(4, "big"))
    with pytest.raises(FrameTooLarge):
        registered(ticks).receive((COMMAND_FRAME + 1).to_bytes(4, "big"))


def test_no_samples_on_the_control_link(ticks: Ticks) -> None:
    """Bulk data on the control link breaks the contract."""
    with pytest.raises(MalformedMessage):
        registered(ticks).receive(frames.encode_sample(1, 2, b"x"))


def test_ping_is_answered_at_once(ticks: Ticks) -> None:
    """A ping comes back with its time and our clock."""
    end = registered(ticks)
    end.receive(link.frame(link.Ping(t=42)))
    assert said(end) == [{"op": "pong", "t": 42, "at": ticks.now}]


def test_silence_of_three_heartbeats_loses_the_link(ticks: Ticks) -> None:
    """A link that said nothing for three heartbeats is lost; any byte keeps it."""
    end = registered(ticks)
    ticks.now += 5_900_000_000
    end.check_silence()
    end.receive(b"\0")
    ticks.now += 5_900_000_000
    end.check_silence()
    ticks.now += 200_000_000
    with pytest.raises(LinkSilent):
        end.check_silence()


def test_join_gives_the_first_offset_and_pings(ticks: Ticks) -> None:
    """A joined channel knows the offset from the answer, and asks three times more at once."""
    end = ChannelLink("ticket", ticks, 2.0)
    end.begin()
    end.take()
    ticks.now += 1000
    (event,) = end.receive(link.frame(link.Joined(channel="c", at=77)))
    assert event == JoinedChannel("c")
    assert end.offset.known
    assert [each["op"] for each in said(end)] == ["ping"] * 3


def test_channel_passes_requests_and_samples(ticks: Ticks) -> None:
    """Requests and samples of an open channel come out in order."""
    end = opened(ticks)
    data = link.frame(link.Unsubscribe(number=1)) + frames.encode_sample(2, 3, b"body")
    assert end.receive(data) == [
        MessageReceived(link.Unsubscribe(number=1)),
        SampleReceived(frames.SampleFrame(2, 3, b"body")),
    ]


def test_samples_before_joining_are_an_error(ticks: Ticks) -> None:
    """A relay that commands before the channel stands is cut off."""
    with pytest.raises(MalformedMessage):
        ChannelLink("ticket", ticks, 2.0).receive(frames.encode_sample(2, 3, b"body"))


def test_enrolment_of_another_robot_is_refused(ticks: Ticks) -> None:
    """A relay that enrols another name than asked for is not believed."""
    request = link.Enroll(version=1, robot="r1", code="c", public_key="k")
    end = EnrolmentLink(request, ticks)
    with pytest.raises(MalformedMessage):
        end.receive(link.frame(link.Enrolled(robot="r2", relay="x")))
    good = link.Enrolled(robot="r1", relay="x")
    assert EnrolmentLink(request, ticks).receive(link.frame(good)) == [EnrolledAt(good)]


@given(st.lists(st.binary(max_size=200), max_size=20), st.booleans())
def test_hostile_bytes_end_in_words(pieces: list[bytes], framed: bool) -> None:
    """Whatever a relay sends, in whatever state, the link answers with events or an error of ours."""
    for end in (ControlLink(ME, "t", Ticks()), registered(Ticks()), opened(Ticks()), shown(Ticks())):
        try:
            for piece in pieces:
                end.receive(frames.encode_json(piece) if framed else piece)
        except SwitchboardError:
            continue


def test_states_have_decoders() -> None:
    """Every state a link can be in knows what may be said in it."""
    known = {*ControlLink._decoders, *ChannelLink._decoders, *VideoLink._decoders, *EnrolmentLink._decoders}
    assert known == set(LinkState)


def test_wrong_utf8_is_refused(ticks: Ticks) -> None:
    """Bytes that are no UTF-8 are refused, also in a field nobody reads."""
    with pytest.raises(PeerError):
        registered(ticks).receive(frames.encode_json(b'{"op":"ping","t":1,"x":"\xff"}'))


def test_video_link_joins_by_ticket(ticks: Ticks) -> None:
    """It says the ticket, is told the stream's name, and asks for the clock at once."""
    end = VideoLink("ticket", ticks, 2.0)
    end.begin()
    assert [(each["op"], each["ticket"]) for each in said(end)] == [("join", "ticket")]
    assert end.receive(link.frame(link.Joined(channel="s", at=5))) == [JoinedChannel("s")]
    assert {each["op"] for each in said(end)} == {"ping"}
    assert end.offset.known


def test_video_link_passes_on_what_the_relay_took(ticks: Ticks) -> None:
    """Answers to pictures and the wish for a key frame are for the stream."""
    end = shown(ticks)
    told = link.frame(link.Took(number=3)) + link.frame(link.KeyFrame())
    assert end.receive(told) == [MessageReceived(link.Took(number=3)), MessageReceived(link.KeyFrame())]


@pytest.mark.parametrize(
    "wrong",
    [
        link.frame(link.Joined(channel="s", at=6)),
        link.frame(link.Unsubscribe(number=1)),
        frames.encode_sample(1, 2, b"x"),
        frames.encode_video(1, 2, b"x"),
    ],
)
def test_video_link_takes_nothing_else(ticks: Ticks, wrong: bytes) -> None:
    """What belongs on other links, and what robots send, breaks the contract."""
    with pytest.raises(PeerError):
        shown(ticks).receive(wrong)
