"""Alerts with their present state, and notification rules."""

from __future__ import annotations

import secrets
from typing import Any

import pytest
from sqlalchemy import event

from relay_db import queries
from relay_db.engine import Database
from relay_db.queries import alerts as module
from relay_db.queries.alerts import MAX_RULES
from relay_protocol.errors import Invalid, NotFound


def an_alert(robot: int, id: str = "a1", **other: object) -> queries.AlertRecord:
    """An open alert."""
    made = queries.AlertRecord(
        id,
        robot,
        "rover",
        "default",
        "offline",
        "",
        "error",
        "it is gone",
        10.0,
        10.5,
        1,
        1,
        None,
        None,
        None,
    )
    return made._replace(**other)  # type: ignore[arg-type]  # the fields of a record


def a_rule(user: int) -> dict[str, object]:
    """Required values of a rule."""
    return {"user_id": user, "level": "warning", "channel": "portal", "group_s": 60.0, "created": 1.5}


def test_an_alert_is_written_again_in_its_place(database: Database) -> None:
    """The same id is the same row, with the present state."""
    with database.begin() as s:
        robot = queries.add_robot(s, "rover").id
        queries.save_alerts(s, [an_alert(robot), an_alert(robot, "b2", last=11.0)])
        queries.save_alerts(s, [an_alert(robot, report_count=3, over=12.25, ack_by="ann", ack_at=11.5)])
    with database.reading() as s:
        assert queries.get_alert(s, "a1") == an_alert(
            robot, report_count=3, over=12.25, ack_by="ann", ack_at=11.5
        )
        assert [each.id for each in queries.list_alerts(s)] == ["b2", "a1"]
        assert [each.id for each in queries.list_alerts(s, open=True)] == ["b2"]
        assert [each.id for each in queries.list_alerts(s, [robot], open=False)] == ["a1"]
        assert queries.list_alerts(s, [robot + 1]) == queries.list_alerts(s, []) == []
        (latest,) = queries.list_alerts(s, limit=1)
        assert [each.id for each in queries.list_alerts(s, after=(latest.last, latest.id))] == ["a1"]
        assert queries.get_alert(s, "nothing\x00") is None


def test_alerts_go_with_their_robot_and_none_comes_for_one_that_is_gone(database: Database) -> None:
    """A robot may be removed before its alert is written."""
    with database.begin() as s:
        robot = queries.add_robot(s, "rover").id
        queries.save_alerts(s, [an_alert(robot)])
        queries.remove_robot(s, robot)
        queries.save_alerts(s, [an_alert(robot, "b2")])
        assert queries.list_alerts(s) == []


def test_recent_alerts_are_open_or_ended_recently(database: Database) -> None:
    """Old ones stay in the table."""
    with database.begin() as s:
        robot = queries.add_robot(s, "rover").id
        queries.save_alerts(
            s, [an_alert(robot), an_alert(robot, "b2", over=20.0), an_alert(robot, "c3", over=30.0)]
        )
        assert sorted(each.id for each in queries.recent_alerts(s, 25.0)) == ["a1", "c3"]


def test_alerts_of_a_robot_do_not_hide_those_of_others(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_MAX_RECENT", 2)
    with database.begin() as s:
        queries.add_realm(s, "lab1")
        loud, quiet = queries.add_robot(s, "rover").id, queries.add_robot(s, "rover", realm="lab1").id
        there = [an_alert(loud, f"l{each}", last=50.0, ack_by="ann", ack_at=60.0) for each in range(5)]
        there += [an_alert(loud, f"o{each}", last=50.0 + each, over=70.0) for each in range(5)]
        theirs = [an_alert(quiet, "q1", ack_by="bob", ack_at=60.0), an_alert(quiet, "q2", over=70.0)]
        queries.save_alerts(s, [*there, *theirs])
        known = queries.recent_alerts(s, 65.0)
        assert sorted(each.id for each in known) == ["l0", "l1", "l2", "l3", "l4", "o3", "o4", "q1", "q2"]
        assert {each.realm for each in known if each.robot_id == quiet} == {"lab1"}
        assert sorted(queries.acknowledgements(s)) == ["l0", "l1", "l2", "l3", "l4", "q1"]


def test_next_page_begins_behind_the_last_alert_and_leaves_out_excluded_ones(database: Database) -> None:
    with database.begin() as s:
        rover, digger = queries.add_robot(s, "rover").id, queries.add_robot(s, "digger").id
        queries.save_alerts(
            s,
            [
                *(an_alert(rover, f"a{each}", kind="stale", about=f"/t{each % 2}") for each in range(4)),
                an_alert(rover, "d1", kind="diagnostics", about="arm"),
                an_alert(digger, "d2", kind="diagnostics", about="arm"),
                an_alert(digger, "d3", kind="stale", about="/t0"),
            ],
        )
        whole = queries.list_alerts(s)
        assert [each.id for each in whole] == ["a0", "a1", "a2", "a3", "d1", "d2", "d3"]
        for number, each in enumerate(whole):
            assert queries.list_alerts(s, after=(each.last, each.id)) == whole[number + 1 :]
        wanted = queries.list_alerts(
            s, except_kinds={"diagnostics": [rover]}, except_alerts=[(rover, "stale", "/t0")]
        )
        assert [each.id for each in wanted] == ["a1", "a3", "d2", "d3"]


@pytest.mark.parametrize(("robots", "index"), [(1, "ix_alert_robot_id"), (50, "ix_alert_last_at")])
def test_a_page_of_a_long_list_is_read_from_where_it_begins(
    sqlite: Database, robots: int, index: str
) -> None:
    asked: list[tuple[str, Any]] = []
    with sqlite.reading() as s:
        connection = s.connection()
        event.listen(
            connection,
            "before_cursor_execute",
            lambda _, __, words, values, *___: asked.append((words, values)),
        )
        queries.list_alerts(s, range(1, robots + 1), after=(1e9, "a1"))
        ((words, values),) = list(asked)
        plan = [row[-1] for row in connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {words}", values)]
    (search,) = [each for each in plan if each.startswith("SEARCH alert")]
    assert index in search
    assert "last_at<?" in search
    assert "USE TEMP B-TREE FOR ORDER BY" not in plan


def test_an_acknowledgement_counts_up_the_revision(database: Database) -> None:
    with database.begin() as s:
        robot = queries.add_robot(s, "rover").id
        queries.save_alerts(s, [an_alert(robot)])
        before = queries.revision(s)
        assert queries.acknowledge_alert(s, "a1", "cli:ann", 12.5).ack_by == "cli:ann"
        assert queries.revision(s) == before + 1
        assert queries.acknowledgements(s) == {"a1": ("cli:ann", 12.5)}
        assert queries.acknowledge_alert(s, "a1", "cli:bob", 13.5).ack_by == "cli:ann"
        assert queries.revision(s) == before + 1
        queries.save_alerts(s, [an_alert(robot, "b2", over=11.0)])
        with pytest.raises(Invalid, match="over"):
            queries.acknowledge_alert(s, "b2", "cli:ann", 12.5)
        assert queries.get_alert(s, "b2") == an_alert(robot, "b2", over=11.0)
        with pytest.raises(NotFound, match="no such alert"):
            queries.acknowledge_alert(s, "z9", "ann", 1.0)


def test_old_alerts_and_too_many_are_forgotten_but_none_that_lasts(database: Database) -> None:
    """The oldest of the ended ones are deleted first, in batches."""
    with database.begin() as s:
        robot = queries.add_robot(s, "rover").id
        over = [an_alert(robot, f"o{each}", last=float(each), over=float(each)) for each in range(6)]
        queries.save_alerts(s, [*over, an_alert(robot, "open", last=0.0)])
        assert queries.purge_alerts(s, 3.0, max_alerts=3, batch=2) == 2
        assert queries.purge_alerts(s, 3.0, max_alerts=3, batch=2) == 1
        assert queries.purge_alerts(s, 3.0, max_alerts=3, batch=2) == 1
        assert queries.purge_alerts(s, 3.0, max_alerts=3, batch=2) == 0
        assert [each.id for each in queries.list_alerts(s)] == ["o5", "o4", "open"]


def test_a_realm_with_too_many_alerts_costs_no_other_one_any(database: Database) -> None:
    """Each has its own limit; even if all surplus alerts of one realm are open, those of the next are
    deleted.
    """
    with database.begin() as s:
        queries.add_realm(s, "lab1")
        queries.add_realm(s, "lab2")
        here = queries.add_robot(s, "rover").id
        lab1, lab2 = (queries.add_robot(s, "rover", realm=each).id for each in ("lab1", "lab2"))
        queries.save_alerts(s, [an_alert(here, f"h{each}") for each in range(4)])
        queries.save_alerts(s, [an_alert(lab1, f"a{each}", last=1.0, over=5.0) for each in range(2)])
        queries.save_alerts(s, [an_alert(lab2, f"b{each}", last=9.0 + each, over=20.0) for each in range(5)])
        assert [queries.purge_alerts(s, 0.0, max_alerts=2, batch=2) for _ in range(3)] == [2, 1, 0]
        assert [each.id for each in queries.list_alerts(s, [lab1, lab2])] == ["b4", "b3", "a0", "a1"]
        assert len(queries.list_alerts(s, [here])) == 4


def test_rules_are_stored_unchanged(database: Database) -> None:
    quiet = {"from": "22:00", "to": "07:00", "zone": "Europe/Rome", "least": "error"}
    with database.begin() as s:
        ann, bob = queries.add_user(s, "ann", None).id, queries.add_user(s, "bob", None).id
        made = queries.add_alert_rule(
            s,
            ann,
            label="pager",
            robots="r*",
            kinds=["offline"],
            level="error",
            channel="webhook",
            url="https://example.org/hook",
            secret="s" * 32,
            notify_end=False,
            group_s=5.0,
            quiet=quiet,
            created=1.5,
        )
        later = {**a_rule(bob), "created": 2.5}
        other = queries.add_alert_rule(s, **later)  # type: ignore[arg-type]  # its fields by name
        assert made == (
            made.id, ann, "ann", "default", "pager", "r*", ("offline",), "error", "webhook",
            "https://example.org/hook", "s" * 32, False, 5.0, quiet, 1.5,
        )  # fmt: skip
        assert queries.list_alert_rules(s) == [made, other]
        queries.set_disabled(s, bob, True)
        assert queries.list_alert_rules(s) == queries.list_alert_rules(s, ann) == [made]
        assert queries.list_alert_rules(s, bob) == [other]


def test_numbers_of_rules_are_drawn(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = iter([2**31 - 2, 2**31 - 2, 6])
    asked: list[int] = []
    monkeypatch.setattr(secrets, "randbelow", lambda below: asked.append(below) or next(drawn))
    with database.begin() as s:
        ann = queries.add_user(s, "ann", None).id
        for created in (1.0, 2.0):
            queries.add_alert_rule(s, **{**a_rule(ann), "created": created})  # type: ignore[arg-type]  # as above
        assert [each.id for each in queries.list_alert_rules(s)] == [2**31 - 1, 7]
    assert asked == [2**31 - 1] * 3


def test_a_rule_is_removed_only_by_its_user(database: Database) -> None:
    with database.begin() as s:
        ann, bob = queries.add_user(s, "ann", None).id, queries.add_user(s, "bob", None).id
        one = queries.add_alert_rule(s, **a_rule(ann)).id  # type: ignore[arg-type]  # as above
        two = queries.add_alert_rule(s, **a_rule(ann)).id  # type: ignore[arg-type]  # as above
        before = queries.revision(s)
        assert not queries.remove_alert_rule(s, one, bob)
        assert queries.revision(s) == before
        assert queries.remove_alert_rule(s, one, ann)
        assert queries.revision(s) == before + 1
        assert [each.id for each in queries.list_alert_rules(s)] == [two]
        queries.remove_user(s, ann)
        assert queries.list_alert_rules(s) == []


def test_a_user_has_a_bounded_number_of_rules(database: Database) -> None:
    with database.begin() as s:
        ann = queries.add_user(s, "ann", None).id
        for _ in range(MAX_RULES):
            queries.add_alert_rule(s, **a_rule(ann))  # type: ignore[arg-type]  # as above
        with pytest.raises(Invalid, match="at most 32"):
            queries.add_alert_rule(s, **a_rule(ann))  # type: ignore[arg-type]  # as above
        with pytest.raises(NotFound):
            queries.add_alert_rule(s, **a_rule(ann + 1))  # type: ignore[arg-type]  # as above


def test_an_acknowledgement_the_relay_has_not_seen_outlives_its_next_word(database: Database) -> None:
    """It ends when the alert becomes worse or returns, as any."""
    with database.begin() as s:
        robot = queries.add_robot(s, "rover").id
        queries.save_alerts(s, [an_alert(robot)])
        queries.acknowledge_alert(s, "a1", "cli:ann", 12.5)
        queries.save_alerts(s, [an_alert(robot, report_count=2, last=13.0)])
        assert queries.acknowledgements(s) == {"a1": ("cli:ann", 12.5)}
        queries.save_alerts(s, [an_alert(robot, report_count=3, last=14.0, over=14.0, notification_count=2)])
        assert queries.get_alert(s, "a1") == an_alert(
            robot, report_count=3, last=14.0, over=14.0, notification_count=2, ack_by="cli:ann", ack_at=12.5
        )
        queries.save_alerts(s, [an_alert(robot, report_count=4, last=15.0, notification_count=2)])
        assert queries.acknowledgements(s) == {}
        queries.acknowledge_alert(s, "a1", "cli:ann", 15.5)
        queries.save_alerts(s, [an_alert(robot, report_count=5, last=16.0, notification_count=3)])
        assert queries.acknowledgements(s) == {}
