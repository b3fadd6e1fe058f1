"""Orders to modules and reports of modules are stored until the robot is back."""

from __future__ import annotations

from relay_db import queries
from relay_db.engine import Database
from relay_db.queries import ModuleReportRecord


def test_the_latest_report_of_each_robot_is_stored(database: Database) -> None:
    with database.begin() as s:
        rover, mule, gone = (queries.add_robot(s, name).id for name in ("rover", "mule", "gone"))
        first = [ModuleReportRecord(each, 1.5, "[]") for each in (rover, mule, gone)]
        queries.store_module_reports(s, first)
        queries.store_module_reports(s, [])
    with database.begin() as s:
        queries.remove_robot(s, gone)
        assert queries.module_reports(s) == first[:2]
        later = [ModuleReportRecord(each, 2.5, '[{"name": "base"}]') for each in (gone, rover)]
        queries.store_module_reports(s, later)
    with database.reading() as s:
        assert queries.module_report(s, rover) == later[1]
        assert queries.module_report(s, mule) == first[1]
        assert queries.module_report(s, gone) is None


def test_an_older_report_replaces_no_newer_one(database: Database) -> None:
    """Another relay may notice late that the robot has left it."""
    with database.begin() as s:
        rover, mule = (queries.add_robot(s, name).id for name in ("rover", "mule"))
        queries.store_module_reports(s, [ModuleReportRecord(rover, 2.5, "[2]")])
        reports = [ModuleReportRecord(rover, 1.5, "[1]"), ModuleReportRecord(mule, 1.5, "[1]")]
        queries.store_module_reports(s, reports)
        assert [each.modules for each in queries.module_reports(s)] == ["[2]", "[1]"]


def test_a_report_from_the_future_is_replaced(database: Database) -> None:
    """The clock of a relay was wrong."""
    with database.begin() as s:
        rover = queries.add_robot(s, "rover").id
        queries.store_module_reports(s, [ModuleReportRecord(rover, 9e9, "[2]")])
        now = ModuleReportRecord(rover, 1.5e9, "[1]")
        queries.store_module_reports(s, [now])
        assert queries.module_report(s, rover) == now


def _order(database: Database, robot: int, at: float) -> queries.ModuleOrderRecord:
    with database.begin() as s:
        return queries.store_module_order(s, robot, "base", start=True, user_id=None, by="ann", at=at)


def test_a_refused_order_stays_with_its_reason_until_the_next_one(database: Database) -> None:
    with database.begin() as s:
        robot = queries.add_robot(s, "rover").id
    first = _order(database, robot, 1.5)
    with database.begin() as s:
        queries.refuse_module_order(s, first, 2.5, "it has no\x1bsuch module")
        (refused,) = queries.module_orders(s, robot)
        assert (refused.at, refused.refused_at, "such module" in refused.refusal) == (1.5, 2.5, True)
        assert "\x1b" not in refused.refusal
        queries.remove_refused_module_orders(s, robot, 2.5)
        assert queries.module_orders(s, robot) == [refused]
    second = _order(database, robot, 3.5)
    with database.begin() as s:
        # The refusal of the first order comes late.
        queries.refuse_module_order(s, first, 4.5, "too late")
        queries.remove_refused_module_orders(s, robot, 9.5)
        assert queries.module_orders(s, robot) == [second]
        queries.refuse_module_order(s, second, 4.5, "no")
        queries.remove_refused_module_orders(s, robot, 9.5)
        assert queries.module_orders(s, robot) == []
