"""The service registry, on both databases: entries registered, found, renewed, changed, and removed."""

from __future__ import annotations

from typing import Any, NamedTuple

import pytest

from relay_db import queries
from relay_db.engine import Database
from relay_db.queries import AlreadyExists, EntryCursor, EntryRecord, EntrySearch, NewEntry, QuotaExceeded

ROOM = {"of_user": 3, "of_realm": 4}


class Filled(NamedTuple):
    """Ann and bob with rover and arm; cleo belongs to another realm."""

    database: Database
    ann: int
    bob: int
    cleo: int
    rover: int
    arm: int

    def enter(self, id: str, now: float = 100.0, **fields: Any) -> tuple[EntryRecord, EntryRecord | None]:
        """Registers an entry, as ann by default."""
        values = {
            "realm": "default",
            "kind": "service",
            "name": "map",
            "address": "http://a/",
            "description": "",
            "robot_id": None,
            "user_id": self.ann,
            "data": "{}",
            "ttl": 60.0,
            **fields,
        }
        with self.database.begin() as s:
            return queries.register_entry(s, NewEntry(**values), id, now, **ROOM)

    def found(self, now: float = 100.0, limit: int = 100, **ask: Any) -> list[str]:
        """Ids of matching entries."""
        with self.database.reading() as s:
            rows = queries.list_entries(s, EntrySearch(**{"realm": "default", **ask}), now, limit)
        return [each.id for each in rows]


@pytest.fixture
def filled(database: Database) -> Filled:
    """A registry without entries."""
    with database.begin() as s:
        queries.add_realm(s, "lab")
        ann, bob = (queries.add_user(s, name, None).id for name in ("ann", "bob"))
        cleo = queries.add_user(s, "cleo", None, realm="lab").id
        rover, arm = (queries.add_robot(s, name).id for name in ("rover", "arm"))
    return Filled(database, ann, bob, cleo, rover, arm)


def test_a_registered_entry_is_returned_with_names(filled: Filled) -> None:
    kept, before = filled.enter(
        "a1", robot_id=filled.rover, description="where is what", data='{"a":1}', ttl=12.5
    )
    assert before is None
    assert kept == EntryRecord(
        "a1", "default", "service", "map", "http://a/", "where is what", filled.rover, "rover",
        filled.ann, "ann", '{"a":1}', 12.5, 100.0, 112.5,
    )  # fmt: skip
    with filled.database.reading() as s:
        assert queries.get_entry(s, "default", "a1", 112.0) == kept
        assert queries.get_entry(s, "default", "a1", 112.5) is None
        assert queries.get_entry(s, "lab", "a1", 100.0) is None
        assert queries.get_entry(s, "default", "a1' OR 1=1", 100.0) is None
        assert queries.all_entries(s, 112.0) == [kept] and queries.all_entries(s, 112.5) == []


def test_registering_again_replaces_the_own_entry(filled: Filled) -> None:
    first, _ = filled.enter("a1")
    again, before = filled.enter("a2", now=110.0, address="http://b/")
    assert before == first
    assert again == first._replace(address="http://b/", expires=170.0)
    with pytest.raises(AlreadyExists, match="ann has registered the service 'map' already"):
        filled.enter("b1", user_id=filled.bob)
    assert filled.enter("b2", user_id=filled.bob, robot_id=filled.arm)[0].robot == "arm"
    assert filled.enter("c1", realm="lab", user_id=filled.cleo)[0].realm == "lab"
    # An expired entry blocks no new one, even before it is deleted.
    assert filled.enter("b3", now=170.0, user_id=filled.bob)[1] is None


def test_a_user_and_a_realm_have_so_many_entries_at_most(filled: Filled) -> None:
    """Expired ones do not count, and a renewed one counts once."""
    for number in range(3):
        filled.enter(f"a{number}", name=f"n{number}")
    with pytest.raises(QuotaExceeded, match="at most 3 entries"):
        filled.enter("a3", name="n3")
    filled.enter("b0", name="n3", user_id=filled.bob)
    with pytest.raises(QuotaExceeded, match="is full"):
        filled.enter("b1", name="n4", user_id=filled.bob)
    assert filled.enter("b2", name="n3", user_id=filled.bob)[0].id == "b0"
    filled.enter("c0", realm="lab", user_id=filled.cleo)
    assert filled.enter("a3", now=160.0, name="n3")[0].id == "a3"


def test_entries_are_found_in_the_order_of_their_places(filled: Filled) -> None:
    """Those about no robot first; by kind, pattern and visible robots, and from a cursor on."""
    filled.enter("a1", name="Zoo")
    filled.enter("a2", name="map", robot_id=filled.rover)
    filled.enter("a3", name="map", robot_id=filled.arm)
    filled.enter("b1", name="apple", kind="application", user_id=filled.bob)
    assert filled.found() == ["b1", "a1", "a3", "a2"]
    assert filled.found(kind="service", name="[Zm]*") == ["a1", "a3", "a2"]
    assert filled.found(name="z*") == []
    assert filled.found(robots=frozenset({filled.rover})) == ["b1", "a1", "a2"]
    assert filled.found(robots=frozenset({filled.rover}), without_robot=False) == ["a2"]
    assert filled.found(robots=frozenset()) == ["b1", "a1"]
    assert filled.found(realm="lab") == filled.found(realm="none") == filled.found(now=160.0) == []
    assert filled.found(limit=2) == ["b1", "a1"]
    assert filled.found(after=EntryCursor("", "service", "Zoo", "a1")) == ["a3", "a2"]
    assert filled.found(after=EntryCursor("", "service", "Zoo", "")) == ["a1", "a3", "a2"]


def test_a_lease_is_renewed_while_it_lasts(filled: Filled) -> None:
    filled.enter("a1", ttl=10.0)
    with filled.database.begin() as s:
        renewed = queries.renew_entry(s, "a1", 105.0)
        assert renewed is not None and renewed.expires == 115.0
        assert queries.renew_entry(s, "a1", 115.0) is None
        assert queries.renew_entry(s, "nobody's", 105.0) is None


def test_an_entry_is_changed_only_as_it_was_read(filled: Filled) -> None:
    """For any change since."""
    read, _ = filled.enter("a1")
    say = {"address": "http://b/", "description": "x", "data": '{"b":2}', "ttl": 5.0}
    with filled.database.begin() as s:
        changed = queries.change_entry(s, read, now=101.0, **say)
        assert changed == read._replace(**say, expires=106.0)
        assert queries.change_entry(s, read, now=101.0, **say) is None
        assert queries.renew_entry(s, "a1", 102.0) is not None
        assert queries.change_entry(s, changed, now=102.0, **say) is None
        now = queries.get_entry(s, "default", "a1", 102.0)
        assert now is not None and queries.change_entry(s, now, now=107.0, **say) is None


def test_an_entry_is_removed_once(filled: Filled) -> None:
    kept, _ = filled.enter("a1")
    filled.enter("a2", name="other")
    with filled.database.begin() as s:
        revision = queries.revision(s)
        assert queries.remove_entry(s, "a1", 160.0) is None
        assert queries.remove_entry(s, "a1", 100.0) == kept
        assert queries.remove_entry(s, "a1", 100.0) is None
        assert queries.revision(s) == revision
        assert queries.remove_entry(s, "a2", 100.0, announce=True) is not None
        assert queries.revision(s) == revision + 1


def test_entries_with_ended_leases_are_deleted(filled: Filled) -> None:
    kept, _ = filled.enter("a1", ttl=10.0)
    filled.enter("a2", name="other")
    with filled.database.begin() as s:
        assert queries.lease_times(s, 110.0) == (frozenset({"a1", "a2"}), 110.0, False)
        assert queries.expire_entries(s, 109.0) == []
        assert queries.expire_entries(s, 110.0) == [kept]
        assert queries.expire_entries(s, 110.0) == []
        assert queries.lease_times(s, 110.0) == (frozenset({"a2"}), 160.0, False)
        assert [each.id for each in queries.expire_entries(s, 1e9)] == ["a2"]
        assert queries.lease_times(s, 110.0) == (frozenset(), None, False)


def test_a_clock_that_is_set_back_prolongs_no_lease(filled: Filled) -> None:
    """It lasts at most its full time from now on."""
    filled.enter("a1", ttl=10.0)
    filled.enter("a2", now=52.0, name="other", ttl=8.0)
    with filled.database.begin() as s:
        assert queries.lease_times(s, 50.0).too_long
        queries.clamp_leases(s, 50.0)
        assert queries.lease_times(s, 50.0) == (frozenset({"a1", "a2"}), 58.0, False)
        assert {each.id: each.expires for each in queries.all_entries(s, 50.0)} == {"a1": 60.0, "a2": 58.0}


def test_entries_go_with_their_user_and_their_robot(filled: Filled) -> None:
    filled.enter("a1", robot_id=filled.rover)
    filled.enter("a2", robot_id=filled.arm)
    filled.enter("b1", user_id=filled.bob)
    with filled.database.begin() as s:
        queries.remove_robot(s, filled.rover)
    assert filled.found() == ["b1", "a2"]
    with filled.database.begin() as s:
        queries.remove_user(s, filled.bob)
    assert filled.found() == ["a2"]
