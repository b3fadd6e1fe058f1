"""The diagram in the portal: the paper's three tasks by mouse and by keyboard, type checks, undo, files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect
from websockets.sync.client import connect

from relay_server.icpi.messages import IcpiMessage, write
from tests.worlds.accessibility import violations
from tests.worlds.browser import checked_pages, open_session, portal
from tests.worlds.diagram import NAME, ROLE, TASKS, DiagramWorld, UserInput, do_tasks, row, table, take_back
from tests.worlds.processes import running
from tests.worlds.small_robot import SmallRobot
from tests.worlds.waiting import wait_for

WAIT_SECONDS = 60.0


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DiagramWorld]:
    portal()
    made = DiagramWorld(tmp_path_factory.mktemp("diagram"))
    with running(made):
        yield made


@pytest.fixture(scope="module")
def page(browser: Browser, world: DiagramWorld) -> Iterator[Page]:
    expect.set_options(timeout=WAIT_SECONDS * 1000)
    with checked_pages(browser, world.url, WAIT_SECONDS) as new_page:
        made = new_page(1280, 900)
        open_session(made, "ann", "correct horse")
        made.goto("/diagram")
        row(made, "robot:rover /cmd_vel").wait_for()
        yield made


@pytest.mark.parametrize("by", TASKS)
def test_the_three_tasks(world: DiagramWorld, page: Page, by: str) -> None:
    efforts = do_tasks(page, world, by)
    print(f"\n{table(efforts)}")
    assert all(each.keys == 0 if by == "mouse" else each.clicks + each.drags == 0 for each in efforts)


def test_a_line_between_unlike_types_is_refused_with_a_reason(page: Page) -> None:
    page.get_by_test_id("view-diagram").click()
    user = UserInput(page)
    user.press_at(row(page, "robot:pad /temperature").get_by_test_id("source"))
    user.drag_to(row(page, "robot:rover /cmd_vel").get_by_test_id("target"))
    expect(page.get_by_test_id("drag-hint")).to_contain_text(
        "/temperature has messages of std_msgs/msg/Float64, /cmd_vel takes geometry_msgs/msg/Twist."
    )
    user.release()
    expect(page.get_by_test_id("undo")).to_have_attribute("title", "Nothing to undo")


def test_a_topic_calls_a_service_and_a_program_is_a_box(world: DiagramWorld, page: Page) -> None:
    page.get_by_test_id("view-diagram").click()
    headers = {"Authorization": f"Bearer {world.token}"}
    url = world.url.replace("http", "ws") + "/icpi"
    user = UserInput(page)
    with connect(url, additional_headers=headers) as program:
        register = IcpiMessage("relay", "", "1", True, "register", ("lamp", '["power"]', '["blink"]'))
        program.send(write(register))
        for source, target in (
            ("robot:pad /temperature", "robot:rover /beep()"),
            ("robot:pad /temperature", "program:lamp power"),
        ):
            row(page, target).wait_for()
            user.press_at(row(page, source).get_by_test_id("source"))
            user.drag_to(row(page, target).get_by_test_id("target"))
            expect(page.get_by_test_id("drag-hint")).to_contain_text("makes a pipe.")
            user.release()
            expect(page.get_by_test_id("panel").get_by_test_id("pipe-state")).to_have_text("running")
        expect(page.locator(".svelte-flow__edge.pipe.running")).to_have_count(2)
        row(page, "robot:pad /beep()").get_by_test_id("open").click()
        success = row(page, "robot:pad /beep()# success")
        success.wait_for()
        user.press_at(success.get_by_test_id("source"))
        user.drag_to(row(page, "robot:rover /cmd_vel").get_by_test_id("target"))
        expect(page.get_by_test_id("drag-hint")).to_contain_text("Open /cmd_vel and choose a field of it.")
        user.release()
        row(page, "robot:pad /beep()").get_by_test_id("open").click()
        take_back(page)
    expect(row(page, "program:lamp power")).to_have_count(0)


def test_a_field_is_sent_in_the_goals_of_an_action(world: DiagramWorld, page: Page) -> None:
    """The relay's own actions are not shown."""
    robot = SmallRobot(
        world.relay, "feeder", {}, actions={"/feed": "float64 amount\n---\nstring words\n---\n"}
    )
    world.relay.cli("right", "grant", "ann", "feeder", "operator")
    robot.comes()
    try:
        page.goto("/diagram")
        user = UserInput(page)
        row(page, "robot:feeder /feed{}").get_by_test_id("open").click()
        row(page, "robot:feeder /feed{}# words").wait_for()
        row(page, "robot:pad /temperature").get_by_test_id("open").click()
        user.press_at(row(page, "robot:pad /temperature#data").get_by_test_id("source"))
        user.drag_to(row(page, "robot:feeder /feed{}#amount").get_by_test_id("target"))
        expect(page.get_by_test_id("drag-hint")).to_contain_text("makes a pipe.")
        user.release()
        expect(page.get_by_test_id("panel").get_by_test_id("pipe-state")).to_have_text("running")
        wait_for("goals arrive", lambda: any(each["amount"] > 0 for each in robot.goals))
        expect(row(page, "robot:feeder /relay/run_function{}")).to_have_count(0)
        take_back(page)
    finally:
        robot.goes()
        world.relay.cli("robot", "remove", "feeder", "--yes")


DROP = """([name, text]) => {
    const data = new DataTransfer()
    data.items.add(new File([text], name))
    for (const type of ['dragover', 'drop'])
        document.body.dispatchEvent(new DragEvent(type, { dataTransfer: data, bubbles: true, cancelable: true }))
}"""


def test_a_dropped_role_is_mapped_downloaded_and_undone(page: Page) -> None:
    page.evaluate(DROP, ["thermometer.rdf", ROLE])
    degrees = row(page, f"role:{NAME} fierro:DEGREES")
    degrees.wait_for()
    user = UserInput(page)
    user.press_at(row(page, f"role:{NAME} fierro:Port_1").get_by_test_id("source"))
    user.drag_to(row(page, f"role:{NAME} fierro:SPEED").get_by_test_id("target"))
    user.release()
    lines = page.locator(".svelte-flow__edge.mapping")
    expect(lines).to_have_count(2)
    page.locator(f'[data-testid=node][data-id="role:{NAME}"]').click()
    texts = {}
    for form in ("rdf", "ttl", "jsonld"):
        with page.expect_download() as download:
            page.get_by_test_id(f"download-{form}").click()
        assert download.value.suggested_filename == f"{NAME}.{form}"
        texts[form] = Path(download.value.path()).read_text()
    assert "fierro:Port_1" in texts["ttl"]
    assert all(text.count("mapping") == 2 for text in texts.values()), texts
    page.get_by_test_id("undo").click()
    expect(lines).to_have_count(1)
    page.get_by_test_id("redo").click()
    expect(lines).to_have_count(2)
    take_back(page)
    expect(page.get_by_test_id("role-state")).to_have_count(0)


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("view", ["diagram", "table"])
def test_no_rule_of_axe_is_broken(page: Page, view: str, width: int) -> None:
    page.set_viewport_size({"width": width, "height": 900})
    page.get_by_test_id(f"view-{view}").click()
    chosen = "element" if view == "diagram" else "row-element"
    page.locator(f'[data-testid={chosen}][data-id="robot:pad /temperature"]').evaluate(
        "button => button.click()"
    )
    expect(page.get_by_test_id("panel-value")).to_contain_text(".")
    assert violations(page) == []
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    page.keyboard.press("Escape")
    expect(page.get_by_test_id("panel")).to_have_count(0)
