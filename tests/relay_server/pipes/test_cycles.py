"""Pipes that would feed themselves."""

from __future__ import annotations

import pytest

from relay_server.pipes.cycles import PipeEdge, end_key, find_cycle
from relay_server.pipes.schemas import PipeEnd


def edge(text: str) -> PipeEdge:
    """``a>b`` is a pipe from a to b, ``a>b~`` one with a rate limit."""
    source, _, target = text.rstrip("~").partition(">")
    return PipeEdge(text, (1, source), (1, target), text.endswith("~"))


@pytest.mark.parametrize(
    ("new", "others", "cycle"),
    [
        ("a>b", [], []),
        ("a>a", [], ["a>a"]),
        ("a>b", ["b>a"], ["a>b", "b>a"]),
        ("a>b", ["b>c", "c>a"], ["a>b", "b>c", "c>a"]),
        ("a>b", ["b>c", "b>d", "d>a"], ["a>b", "b>d", "d>a"]),
        ("a>b", ["b>c", "c>b"], []),
        ("a>b", ["c>a"], []),
        ("a>b~", ["b>a"], []),
        ("a>b", ["b>a~"], []),
        ("a>b", ["b>c~", "c>a"], []),
    ],
)
def test_a_cycle_is_found_unless_a_rate_limit_breaks_it(
    new: str, others: list[str], cycle: list[str]
) -> None:
    assert find_cycle(edge(new), [edge(each) for each in others]) == cycle


def test_topics_of_different_robots_are_different() -> None:
    there, back = PipeEdge("x", (1, "/a"), (2, "/a"), False), PipeEdge("y", (3, "/a"), (1, "/a"), False)
    assert find_cycle(there, [back]) == []


def test_the_feedback_of_an_action_is_a_part_of_it() -> None:
    """A goal causes feedback, so a pipe from the feedback to what sends the goals feeds itself."""
    feedback, other, dock = (
        end_key(PipeEnd(robot="rover", **{kind: name}), 1, 2)
        for kind, name in (
            ("topic", "/dock/_action/feedback"),
            ("topic", "/dock/action/feedback"),
            ("action", "/dock"),
        )
    )
    assert feedback == dock
    assert other != dock
