"""Memory that users share."""

from __future__ import annotations

import pytest
from twisted.internet.defer import Deferred

from relay_server.common.byte_budget import ByteBudget

ANN, BOB, EVE = 1, 2, 3


class Scene:
    """A budget of 10 bytes for each user and 15 for all, and what was granted."""

    def __init__(self) -> None:
        self.budget = ByteBudget(10, 15)
        self.granted: list[str] = []

    def reserve(self, name: str, user: int, size: int) -> Deferred[None]:
        """Reserve memory under a name."""
        reserved = self.budget.reserve(user, size)
        reserved.addCallbacks(lambda _: self.granted.append(name), lambda _: None)
        return reserved


@pytest.fixture
def scene() -> Scene:
    """Nothing is reserved."""
    return Scene()


def test_a_user_over_its_limit_waits_and_does_not_hold_up_others(scene: Scene) -> None:
    scene.reserve("a", ANN, 8)
    scene.reserve("b", ANN, 3)
    scene.reserve("c", ANN, 1)
    scene.reserve("d", BOB, 5)
    assert scene.granted == ["a", "d"]
    scene.budget.release(ANN, 8)
    assert scene.granted == ["a", "d", "b", "c"]
    assert scene.budget.reserved == 9


def test_a_large_request_is_not_overtaken_by_small_ones_for_ever(scene: Scene) -> None:
    scene.reserve("a", ANN, 10)
    scene.reserve("large", BOB, 10)
    scene.reserve("small", EVE, 1)
    assert scene.granted == ["a"]
    scene.budget.release(ANN, 10)
    assert scene.granted == ["a", "large", "small"]


def test_a_request_that_is_cancelled_holds_up_nothing(scene: Scene) -> None:
    scene.reserve("a", ANN, 10)
    large = scene.reserve("large", BOB, 10)
    scene.reserve("small", EVE, 5)
    large.cancel()
    assert scene.granted == ["a", "small"]
    scene.budget.release(ANN, 10)
    scene.budget.release(EVE, 5)
    assert scene.budget.reserved == 0


def test_many_grants_that_release_at_once_do_not_nest(scene: Scene) -> None:
    scene.reserve("a", ANN, 10)
    for _ in range(2000):
        scene.reserve("b", ANN, 10).addCallback(lambda _: scene.budget.release(ANN, 10))
    scene.budget.release(ANN, 10)
    assert len(scene.granted) == 2001


def test_more_than_a_user_may_have_is_an_error(scene: Scene) -> None:
    with pytest.raises(ValueError, match="exceed"):
        scene.budget.reserve(ANN, 11)
