"""The robot's links: bytes in, events and bytes out."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol import frames, identity, link
from relay_protocol.errors import FrameTooLarge, MalformedMessage, PeerError, SwitchboardError
from relay_protocol.limits import HANDSHAKE_FRAME, RELAY_JSON_FRAME
from robot_client.link.links import (
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
    end = ControlLink(ME, "test", ticks)
    end.begin()
    (hello,) = said(end)
    assert hello["op"] == "hello"
    assert hello["robot"] == "r1"
    assert hello["key"] == identity.fingerprint(identity.public_half(KEY))
    assert hello["encodings"] == ["cdr"]


def test_proof_covers_relay_robot_and_nonce(ticks: Ticks) -> None:
    (prove,) = said(challenged(ticks))
    signature = link.from_base64(str(prove["signature"]), "signature")
    assert identity.verify(identity.public_half(KEY), "relay-1", "r1", NONCE, signature)


def test_other_relay_gets_no_signature(ticks: Ticks) -> None:
    end = ControlLink(ME, "test", ticks)
    end.begin()
    end.take()
    with pytest.raises(WrongRelay, match="enrolled at 'relay-1'"):
        end.receive(link.frame(link.Challenge(nonce=link.to_base64(NONCE), relay="evil")))
    assert end.take() == []


@pytest.mark.parametrize("nonce", [b"", bytes(31), bytes(33)])
def test_short_nonce_is_not_signed(ticks: Ticks, nonce: bytes) -> None:
    end = ControlLink(ME, "test", ticks)
    with pytest.raises(MalformedMessage):
        end.receive(link.frame(link.Challenge(nonce=link.to_base64(nonce), relay="relay-1")))


def test_welcome_registers_the_robot(ticks: Ticks) -> None:
    end = challenged(ticks)
    (event,) = end.receive(link.frame(link.Welcome(session="s", heartbeat=3.0, frame_limit=9)))
    assert isinstance(event, Registered)
    assert end.heartbeat == 3.0
    (order,) = end.receive(link.frame(link.OpenChannel(channel="c", ticket="t")))
    assert order == MessageReceived(link.OpenChannel(channel="c", ticket="t"))


def test_registered_link_accepts_requests_for_streams(ticks: Ticks) -> None:
    orders = [
        link.OpenVideo(stream="s", ticket="t", camera="/c", settings=link.VideoSettings(width=3)),
        link.CloseVideo(stream="s"),
    ]
    assert registered(ticks).receive(b"".join(map(link.frame, orders))) == [
        MessageReceived(each) for each in orders
    ]


def test_welcome_before_proof_is_an_error(ticks: Ticks) -> None:
    end = ControlLink(ME, "test", ticks)
    with pytest.raises(MalformedMessage, match="welcome"):
        end.receive(link.frame(link.Welcome(session="s", heartbeat=2.0, frame_limit=9)))


def test_refusal_has_reason_and_retry_after(ticks: Ticks) -> None:
    end = ControlLink(ME, "test", ticks)
    with pytest.raises(RelayRefused, match="no such robot") as caught:
        end.receive(link.frame(link.Refused(reason="no such robot", retry_after=7)))
    assert caught.value.retry_after == 7


@pytest.mark.parametrize("size", [HANDSHAKE_FRAME + 1, 2**32 - 1])
def test_large_frames_are_refused_before_registration(ticks: Ticks, size: int) -> None:
    """Over 16 KiB, by their length."""
    end = ControlLink(ME, "test", ticks)
    with pytest.raises(FrameTooLarge):
        end.receive(size.to_bytes(4, "big"))


def test_frame_limit_grows_with_registration(ticks: Ticks) -> None:
    end = registered(ticks)
    end.receive(RELAY_JSON_FRAME.to_bytes(4, "big"))
    with pytest.raises(FrameTooLarge):
        registered(ticks).receive((RELAY_JSON_FRAME + 1).to_bytes(4, "big"))


def test_samples_on_the_control_link_are_an_error(ticks: Ticks) -> None:
    with pytest.raises(MalformedMessage):
        registered(ticks).receive(frames.encode_sample(1, 2, b"x"))


def test_ping_is_answered_at_once(ticks: Ticks) -> None:
    end = registered(ticks)
    end.receive(link.frame(link.Ping(t=42)))
    assert said(end) == [{"op": "pong", "t": 42, "at": ticks.now}]


def test_silence_of_three_heartbeats_loses_the_link(ticks: Ticks) -> None:
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
    end = ChannelLink("ticket", ticks, 2.0)
    end.begin()
    end.take()
    ticks.now += 1000
    (event,) = end.receive(link.frame(link.Joined(channel="c", at=77)))
    assert event == JoinedChannel("c")
    assert end.offset.known
    assert [each["op"] for each in said(end)] == ["ping"] * 3


def test_channel_passes_requests_and_samples(ticks: Ticks) -> None:
    """In order."""
    end = opened(ticks)
    data = link.frame(link.Unsubscribe(number=1)) + frames.encode_sample(2, 3, b"body")
    assert end.receive(data) == [
        MessageReceived(link.Unsubscribe(number=1)),
        SampleReceived(frames.SampleFrame(2, 3, b"body")),
    ]


def test_samples_before_joining_are_an_error(ticks: Ticks) -> None:
    with pytest.raises(MalformedMessage):
        ChannelLink("ticket", ticks, 2.0).receive(frames.encode_sample(2, 3, b"body"))


def test_enrolment_of_another_robot_is_refused(ticks: Ticks) -> None:
    request = link.Enroll(version=1, robot="r1", code="c", public_key="k")
    end = EnrolmentLink(request, ticks)
    with pytest.raises(MalformedMessage):
        end.receive(link.frame(link.Enrolled(robot="r2", relay="x")))
    good = link.Enrolled(robot="r1", relay="x")
    assert EnrolmentLink(request, ticks).receive(link.frame(good)) == [EnrolledAt(good)]


@given(st.lists(st.binary(max_size=200), max_size=20), st.booleans())
def test_any_bytes_give_events_or_an_error(pieces: list[bytes], framed: bool) -> None:
    """In every state."""
    for end in (ControlLink(ME, "t", Ticks()), registered(Ticks()), opened(Ticks()), shown(Ticks())):
        try:
            for piece in pieces:
                end.receive(frames.encode_json(piece) if framed else piece)
        except SwitchboardError:
            continue


def test_every_state_has_a_decoder() -> None:
    known = {*ControlLink._decoders, *ChannelLink._decoders, *VideoLink._decoders, *EnrolmentLink._decoders}
    assert known == set(LinkState)


def test_invalid_utf8_is_refused(ticks: Ticks) -> None:
    """Also in a field that is not used."""
    with pytest.raises(PeerError):
        registered(ticks).receive(frames.encode_json(b'{"op":"ping","t":1,"x":"\xff"}'))


def test_video_link_joins_by_ticket(ticks: Ticks) -> None:
    end = VideoLink("ticket", ticks, 2.0)
    end.begin()
    assert [(each["op"], each["ticket"]) for each in said(end)] == [("join", "ticket")]
    assert end.receive(link.frame(link.Joined(channel="s", at=5))) == [JoinedChannel("s")]
    assert {each["op"] for each in said(end)} == {"ping"}
    assert end.offset.known


def test_video_link_passes_acknowledgements_and_key_frame_requests(ticks: Ticks) -> None:
    end = shown(ticks)
    data = link.frame(link.FrameAck(number=3)) + link.frame(link.RequestKeyFrame())
    assert end.receive(data) == [
        MessageReceived(link.FrameAck(number=3)),
        MessageReceived(link.RequestKeyFrame()),
    ]


@pytest.mark.parametrize(
    "wrong",
    [
        link.frame(link.Joined(channel="s", at=6)),
        link.frame(link.Unsubscribe(number=1)),
        frames.encode_sample(1, 2, b"x"),
        frames.encode_video(1, 2, b"x"),
    ],
)
def test_video_link_refuses_other_messages(ticks: Ticks, wrong: bytes) -> None:
    with pytest.raises(PeerError):
        shown(ticks).receive(wrong)
