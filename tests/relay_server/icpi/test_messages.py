"""ICPI messages: valid ones, refused ones with their errors, and values that survive unchanged."""

from __future__ import annotations

import pytest

from relay_protocol.errors import Invalid
from relay_server.icpi.messages import IcpiMessage, id_of, parse, write


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "Drive!sn!pad!id!7!ak!1!fx!set!ar!(0)SPEED(1)0.5!br!0",
            IcpiMessage("Drive", "pad", "7", True, "set", ("SPEED", "0.5")),
        ),
        ("relay!sn!!id!0!ak!0!fx!programs!ar!!br!0", IcpiMessage("relay", "", "0", False, "programs")),
        ("!sn!pad!id!1!ak!0!fx!changed!ar!!br!1", IcpiMessage("", "pad", "1", False, "changed", (), True)),
        (
            "lamp!sn!pad!id!1!ak!0!fx!say!ar!(0)a%21%28b)%25(1)!br!0",
            IcpiMessage("lamp", "pad", "1", False, "say", ("a!(b)%", "")),
        ),
        (
            "lamp!sn!pad!id!prio 5!ak!0!fx!say!ar!(0)20 °C!br!0",
            IcpiMessage("lamp", "pad", "prio 5", False, "say", ("20 °C",)),
        ),
        (
            "lamp!sn!pad!id!!ak!0!fx!say!ar!!br!0",
            IcpiMessage("lamp", "pad", "", False, "say"),
        ),
    ],
)
def test_messages_are_read_and_written(text: str, message: IcpiMessage) -> None:
    assert parse(text) == message
    assert write(message) == text


GOOD = "lamp!sn!pad!id!1!ak!0!fx!say!ar!(0)x!br!0"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "this has 1 parts between '!'; a message has 13"),
        (GOOD + "!", "this has 14 parts"),
        (GOOD.replace("!id!", "!no!"), "'no' stands where 'id' must stand"),
        (GOOD.replace("!sn!", "|sn|"), "this has 11 parts"),
        (GOOD.replace("!ak!0", "!ak!yes"), "'yes' stands where 'ak' must be 0 or 1"),
        (GOOD.replace("!id!1", "!id!a\nb"), "is no id"),
        (GOOD.replace("!id!1", "!id!" + "9" * 65), "is no id: it has 64 characters at most"),
        (GOOD.replace("say", "say it"), "'say it' is no function"),
        (GOOD.replace("lamp!", "!", 1), "'' is no receiver"),
        (GOOD.replace("lamp!", "la\nmp!", 1), "is no receiver"),
        (GOOD.replace("(0)x", "x"), "argument 0 must begin with '(0)', not 'x'"),
        (GOOD.replace("(0)x", "(1)x"), "argument 0 must begin with"),
        (GOOD.replace("(0)x", "(0)x(2)y"), "argument 1 must begin with '(1)'"),
        (GOOD.replace("(0)x", "(0)x(1"), "argument 1 must begin with"),
        (GOOD.replace("(0)x", "(0)%zz"), "'%zz' is no escape"),
        (GOOD.replace("(0)x", "(0)%"), "'%' is no escape"),
        (GOOD.replace("(0)x", "(0)%5"), "'%5' is no escape"),
        (GOOD.replace("(0)x", "(0)%ff"), "the escapes of '%ff' are not UTF-8"),
        (GOOD.replace("(0)x", "".join(f"({each})" for each in range(33))), "more than 32 arguments"),
    ],
)
def test_broken_messages_are_refused_with_a_reason(text: str, words: str) -> None:
    with pytest.raises(Invalid) as error:
        parse(text)
    assert words in str(error.value)


def test_an_answer_to_a_broken_message_has_its_id() -> None:
    assert [id_of(each) for each in ("lamp!id!12!x", "no message", "!id!x!")] == ["12", "", "x"]


def test_escapes_are_read_as_utf_8() -> None:
    assert parse(GOOD.replace("(0)x", "(0)20%20%C2%B0C%f0%9f%a4%96")).args == ("20 °C🤖",)
