"""What those who follow the directory hear."""

from __future__ import annotations

from relay_server.registry.changes import AT_ONCE, Changes
from tests.relay_server.directory.test_entries import RECORD

ELSEWHERE = RECORD._replace(realm="lab")


def test_a_follower_hears_what_comes_in_his_realm() -> None:
    """Each once, with its number; he is woken for nothing else."""
    changes = Changes("e1")
    changes.tell("registered", RECORD)
    follower, missed = changes.follow("default", None)
    assert not missed and changes.news("default", follower) == ([], False, False)
    changes.tell("registered", ELSEWHERE)
    assert not follower.fresh
    changes.tell("changed", RECORD)
    changes.tell("removed", RECORD)
    assert follower.fresh
    news = changes.news("default", follower)
    assert [(each.number, each.what) for each in news.changes] == [(2, "changed"), (3, "removed")]
    assert changes.news("default", follower).changes == []
    changes.leave(follower)
    changes.leave(follower)
    changes.tell("registered", RECORD)
    assert not follower.fresh


def test_who_comes_back_hears_what_he_has_missed() -> None:
    """By the mark he was given; what is not known any more is said to be missed."""
    changes = Changes("e1", size=3)
    for _ in range(5):
        changes.tell("changed", RECORD)
    follower, missed = changes.follow("default", "e1-3")
    news = changes.news("default", follower)
    assert not missed and not news.missed and [each.number for each in news.changes] == [4, 5]
    assert changes.mark(follower.number) == "e1-5"
    follower, missed = changes.follow("default", "e1-1")
    news = changes.news("default", follower)
    assert not missed and news.missed and [each.number for each in news.changes] == [3, 4, 5]


def test_the_mark_of_another_run_of_the_relay_means_that_all_may_be_missed() -> None:
    """So does one that can't be; one that is ahead is that of the latest."""
    changes = Changes("e2")
    changes.tell("changed", RECORD)
    for mark in ("e1-1", "1", "e2-", "e2-x", "e2-" + "9" * 30, "e2-\u0663"):
        follower, missed = changes.follow("default", mark)
        assert missed and changes.news("default", follower).changes == [], mark
    follower, missed = changes.follow("default", "e2-7")
    assert not missed and follower.number == 1


def test_many_changes_come_some_at_a_time() -> None:
    """With the word that there are more."""
    changes = Changes("e1")
    follower, _ = changes.follow("default", None)
    for _ in range(AT_ONCE + 1):
        changes.tell("changed", RECORD)
    first, second = changes.news("default", follower), changes.news("default", follower)
    assert (len(first.changes), first.more) == (AT_ONCE, True)
    assert (len(second.changes), second.more) == (1, False)


def test_of_a_realm_that_is_gone_nothing_is_told_any_more() -> None:
    """Neither what came in it, nor to who followed it what comes in another of its name."""
    changes = Changes("e1")
    former, _ = changes.follow("lab", None)
    here, _ = changes.follow("default", None)
    changes.tell("registered", ELSEWHERE)
    changes.tell("registered", RECORD)
    changes.forget("lab")
    assert changes.news("lab", former).changes == []
    later, _ = changes.follow("lab", "e1-0")
    assert changes.news("lab", later).changes == []
    changes.tell("changed", ELSEWHERE)
    assert [each.what for each in changes.news("lab", later).changes] == ["changed"]
    assert changes.news("lab", former).changes == []
    assert len(changes.news("default", here).changes) == 1
    changes.leave(former)
