"""Changes that followers of the service registry receive."""

from __future__ import annotations

from relay_server.service_registry.changes import FOLLOWED_AT_ONCE, RecentEntryChanges
from tests.relay_server.service_registry.test_entries import RECORD

ELSEWHERE = RECORD._replace(realm="lab")


def test_a_follower_receives_changes_of_its_realm() -> None:
    """Each once, with its number; other realms' changes do not wake the follower."""
    changes = RecentEntryChanges("e1")
    changes.publish("registered", RECORD)
    follower, missed = changes.follow("default", None)
    assert not missed and changes.news("default", follower) == ([], False, False)
    changes.publish("registered", ELSEWHERE)
    assert not follower.fresh
    changes.publish("changed", RECORD)
    changes.publish("removed", RECORD)
    assert follower.fresh
    news = changes.news("default", follower)
    assert [(each.number, each.what) for each in news.changes] == [(2, "changed"), (3, "removed")]
    assert changes.news("default", follower).changes == []
    changes.unfollow(follower)
    changes.unfollow(follower)
    changes.publish("registered", RECORD)
    assert not follower.fresh


def test_returning_reader_receives_missed_events() -> None:
    """By the cursor of the last one; unknown cursors mean that events may be missing."""
    changes = RecentEntryChanges("e1", size=3)
    for _ in range(5):
        changes.publish("changed", RECORD)
    follower, missed = changes.follow("default", "e1-3")
    news = changes.news("default", follower)
    assert not missed and not news.missed and [each.number for each in news.changes] == [4, 5]
    assert changes.event_id(follower.number) == "e1-5"
    follower, missed = changes.follow("default", "e1-1")
    news = changes.news("default", follower)
    assert not missed and news.missed and [each.number for each in news.changes] == [3, 4, 5]


def test_the_mark_of_another_run_of_the_relay_means_that_all_may_be_missed() -> None:
    """Invalid cursors mean the same; one that is ahead counts as the latest."""
    changes = RecentEntryChanges("e2")
    changes.publish("changed", RECORD)
    for mark in ("e1-1", "1", "e2-", "e2-x", "e2-" + "9" * 30, "e2-\u0663"):
        follower, missed = changes.follow("default", mark)
        assert missed and changes.news("default", follower).changes == [], mark
    follower, missed = changes.follow("default", "e2-7")
    assert not missed and follower.number == 1


def test_many_changes_come_some_at_a_time() -> None:
    """The answer says that there are more."""
    changes = RecentEntryChanges("e1")
    follower, _ = changes.follow("default", None)
    for _ in range(FOLLOWED_AT_ONCE + 1):
        changes.publish("changed", RECORD)
    first, second = changes.news("default", follower), changes.news("default", follower)
    assert (len(first.changes), first.more) == (FOLLOWED_AT_ONCE, True)
    assert (len(second.changes), second.more) == (1, False)


def test_no_changes_of_a_removed_realm_are_sent() -> None:
    """Neither its own changes, nor changes of a new realm with the same name to old followers."""
    changes = RecentEntryChanges("e1")
    former, _ = changes.follow("lab", None)
    here, _ = changes.follow("default", None)
    changes.publish("registered", ELSEWHERE)
    changes.publish("registered", RECORD)
    changes.forget_realm("lab")
    assert changes.news("lab", former).changes == []
    later, _ = changes.follow("lab", "e1-0")
    assert changes.news("lab", later).changes == []
    changes.publish("changed", ELSEWHERE)
    assert [each.what for each in changes.news("lab", later).changes] == ["changed"]
    assert changes.news("lab", former).changes == []
    assert len(changes.news("default", here).changes) == 1
    changes.unfollow(former)
