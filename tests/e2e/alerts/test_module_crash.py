"""A module of a real daemon crashes: the alert reaches the HTTP API, the portal and a webhook."""

from __future__ import annotations

import os
import signal
import sys
from typing import Any

from playwright.sync_api import Browser, expect

from tests.worlds.alert_relay import AlertWorld
from tests.worlds.browser import checked_pages, open_session, portal, seen
from tests.worlds.http_requests import ask
from tests.worlds.processes import running
from tests.worlds.robot_process import Robot
from tests.worlds.waiting import PATIENCE, wait_for

PASSWORD = "correct horse"
ARM = f"""
[[module]]
name = "arm"
command = ["{sys.executable}", "-c", "import signal; print('the arm is up', flush=True); signal.pause()"]
ready_log = "is up"
restart = "never"
"""


def test_a_crash_reaches_the_api_the_portal_and_a_webhook(world: AlertWorld, browser: Browser) -> None:
    portal()
    rule = world.rule(robots="loader", kinds=["module"])
    robot = Robot(world.relay, "loader", settings=ARM)
    url = f"http://127.0.0.1:{world.relay.http_port}"
    with running(robot), checked_pages(browser, url, PATIENCE) as new_page:
        world.relay.cli("right", "grant", "viewer", "loader", "viewer")
        page = new_page(1280, 900)
        open_session(page, "viewer", PASSWORD)
        page.goto("/alerts")
        card = page.locator("[data-testid=alert][data-kind=module][data-robot=loader]")
        expect(seen(page, "alerts-robot")).to_be_visible()
        expect(card).to_have_count(0)
        wait_for("the arm runs", lambda: arm(world)["state"] == "running")
        crashed = arm(world)["pid"]

        os.kill(crashed, signal.SIGSEGV)

        wait_for("the webhook receives it", lambda: world.webhook_receiver.got)
        (delivery,) = world.webhook_receiver.got
        assert delivery.signed_with(rule["secret"])
        (sent,) = delivery.json["alerts"]
        assert (sent["robot"], sent["kind"], sent["about"], sent["event"]) == (
            "loader",
            "module",
            "arm",
            "begun",
        )
        assert "SIGSEGV" in sent["text"]
        (open_alert,) = world.modules("loader")
        assert [open_alert[each] for each in ("id", "about", "level", "text", "state")] == [
            sent["id"],
            "arm",
            "error",
            sent["text"],
            "open",
        ]
        expect(card).to_contain_text("loader")
        expect(card).to_contain_text(sent["text"])
        assert (arm(world)["state"], arm(world)["pid"]) == ("failed", None)

        assert order(world, "start").status == 202

        wait_for("the webhook receives its end", lambda: len(world.webhook_receiver.got) > 1)
        assert world.webhook_receiver.reported == ["module begun", "module over"]
        assert world.modules("loader") == []
        expect(card).to_have_count(0)
        assert arm(world)["pid"] not in (crashed, None)


def arm(world: AlertWorld) -> dict[str, Any]:
    """The module, as its owner sees it."""
    answer = ask(world.relay.http_port, "GET", "/api/v1/robots/loader/modules/arm", token=world.admin)
    assert answer.status == 200, answer.body
    return dict(answer.json)


def order(world: AlertWorld, action: str) -> Any:
    path = f"/api/v1/robots/loader/modules/arm/{action}"
    return ask(world.relay.http_port, "POST", path, token=world.admin)
