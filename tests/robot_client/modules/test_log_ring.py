"""A module's log on disk: bounded, readable by offset, whatever the disk does."""

from __future__ import annotations

from pathlib import Path

import pytest

from robot_client.modules import log_ring
from robot_client.modules.log_ring import (
    LEVELS,
    LINE_BYTES,
    LogRing,
    ModuleLogLine,
    end_of,
    read,
    read_before,
)

SIZE = 128 * 1024


def line(text: str) -> ModuleLogLine:
    return ModuleLogLine(1.5, "out", "info", text)


def on_disk(folder: Path) -> int:
    return sum(each.stat().st_size for each in folder.iterdir())


def test_lines_are_read_in_order(tmp_path: Path) -> None:
    ring = LogRing(tmp_path, SIZE)
    for number in range(5):
        ring.write(line(str(number)))
    assert [each.text for each in read(tmp_path).lines] == ["0", "1", "2", "3", "4"]
    assert [each.text for each in read_before(tmp_path, None, 2).lines] == ["3", "4"]


def test_pages_join_without_a_gap(tmp_path: Path) -> None:
    ring = LogRing(tmp_path, SIZE)
    for number in range(7):
        ring.write(line(str(number)))
    texts, after = [], 0
    while (page := read(tmp_path, after, most=3)).lines:
        texts += [each.text for each in page.lines]
        after = page.next
    assert texts == [str(number) for number in range(7)]


def levelled(folder: Path, levels: list[str]) -> None:
    """Writes a line for each level, whose text is its number."""
    ring = LogRing(folder, SIZE)
    for number, level in enumerate(levels):
        ring.write(ModuleLogLine(1.5, "out", level, str(number)))
    ring.close()


@pytest.mark.parametrize("most", [1, 3, 50])
@pytest.mark.parametrize("level", ["debug", "warn", "error", "fatal"])
def test_pages_backwards_join_without_a_gap(tmp_path: Path, most: int, level: str) -> None:
    levels = ["info", "warn", "debug", "error", "info", "error", "warn", "info"]
    levelled(tmp_path, levels)
    texts: list[str] = []
    page = read_before(tmp_path, None, most, level)
    assert page.next == end_of(tmp_path)
    while True:
        assert len(page.lines) <= most
        texts[:0] = [each.text for each in page.lines]
        if not page.previous:
            break
        page = read_before(tmp_path, page.previous, most, level)
    least = LEVELS.index(level)
    assert texts == [str(number) for number, each in enumerate(levels) if LEVELS.index(each) >= least]


def test_pages_forwards_have_the_wanted_level_only(tmp_path: Path) -> None:
    levelled(tmp_path, ["info", "error", "warn", "info", "fatal", "info"])
    first = read(tmp_path, 0, 2, "warn")
    assert [each.text for each in first.lines] == ["1", "2"]
    second = read(tmp_path, first.next, 2, "warn")
    assert ([each.text for each in second.lines], second.next) == (["4"], end_of(tmp_path))
    assert [each.text for each in read_before(tmp_path, first.next, 2).lines] == ["1", "2"]


@pytest.mark.parametrize("number", [0, 7])
def test_a_rare_line_is_found_page_by_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """One request reads a bounded part of the log."""
    monkeypatch.setattr(log_ring, "SCAN_BYTES", 500)
    levelled(tmp_path, ["error" if each == number else "info" for each in range(40)])
    page, pages = read_before(tmp_path, None, 10, "error"), 1
    while not page.lines:
        page, pages = read_before(tmp_path, page.previous, 10, "error"), pages + 1
    assert ([each.text for each in page.lines], pages > 3) == ([str(number)], True)
    forwards, pages = read(tmp_path, page.next, 10, "info"), 1
    while forwards.next < end_of(tmp_path):
        forwards, pages = read(tmp_path, forwards.next, 10, "error"), pages + 1
    assert pages > 2


def test_no_line_is_in_front_of_the_oldest_one_on_disk(tmp_path: Path) -> None:
    ring = LogRing(tmp_path, SIZE)
    first = 0
    for number in range(400):
        ring.write(line(f"{number} " + "x" * 2000))
        first = first or read(tmp_path).next
    page = read_before(tmp_path, None, 1000)
    while page.previous:
        earlier = read_before(tmp_path, page.previous, 1000)
        assert earlier.next == page.previous
        page = earlier
    assert page.lines == read(tmp_path).lines[: len(page.lines)]
    gone = read_before(tmp_path, first, 10)
    assert (gone.lines, gone.previous) == ([], 0)


@pytest.mark.parametrize("lines", [1, 50, 400])
def test_size_is_bounded_and_the_newest_lines_stay(tmp_path: Path, lines: int) -> None:
    ring = LogRing(tmp_path, SIZE)
    for number in range(lines):
        ring.write(line(f"{number} " + "x" * 2000))
        assert on_disk(tmp_path) <= SIZE + 2 * LINE_BYTES
    assert read_before(tmp_path, None, 1).lines[0].text.startswith(f"{lines - 1} ")


def test_missed_lines_are_reported(tmp_path: Path) -> None:
    ring = LogRing(tmp_path, SIZE)
    ring.write(line("first"))
    after = read(tmp_path).next
    assert not read(tmp_path, after).missed
    for _ in range(400):
        ring.write(line("x" * 2000))
    assert read(tmp_path, after).missed


def test_later_writer_continues_the_log(tmp_path: Path) -> None:
    first = LogRing(tmp_path, SIZE)
    first.write(line("one"))
    first.close()
    after = read(tmp_path).next
    LogRing(tmp_path, SIZE).write(line("two"))
    assert [each.text for each in read(tmp_path).lines] == ["one", "two"]
    assert [each.text for each in read(tmp_path, after).lines] == ["two"]


def test_torn_line_affects_no_other(tmp_path: Path) -> None:
    ring = LogRing(tmp_path, SIZE)
    ring.write(line("whole"))
    ring.close()
    (segment,) = tmp_path.iterdir()
    with segment.open("ab") as file:
        file.write(b'{"at": 1, "stre\n')
    LogRing(tmp_path, SIZE).write(line("after"))
    assert [each.text for each in read(tmp_path).lines] == ["whole", "after"]


def test_lines_that_can_not_be_written_are_counted_and_reported_afterwards(tmp_path: Path) -> None:
    folder = tmp_path / "log"
    folder.write_text("a file where the folder should be")
    ring = LogRing(folder, SIZE)
    for _ in range(3):
        ring.write(line("lost"))
    assert ring.lost == 3
    folder.unlink()
    ring.write(line("written"))
    assert ring.lost == 0
    assert [(each.stream, each.text) for each in read(folder).lines] == [
        ("runner", "3 lines of output were lost: File exists"),
        ("out", "written"),
    ]
