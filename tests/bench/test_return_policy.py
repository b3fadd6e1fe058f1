"""How long modules may take to be back after a kill."""

from __future__ import annotations

import pytest

from bench.modules import ALLOWANCE, ReturnPolicy
from robot_client.modules.settings import ModuleSettings
from robot_client.modules.supervisor import LONGEST_BACKOFF

STOP = {"term_after_s": 0.5, "kill_after_s": 0.5}


@pytest.fixture
def policy() -> ReturnPolicy:
    short = {"backoff_s": 0.25, "within_s": 10.0, **STOP}
    return ReturnPolicy(
        [
            ModuleSettings(name="base", command=["true"], **short),
            ModuleSettings(name="arm", command=["true"], after=["base"], **short),
            ModuleSettings(name="log", python="a:Log", ready_within_s=5.0, **short),
        ]
    )


def test_the_pause_doubles_with_each_crash_that_counts(policy: ReturnPolicy) -> None:
    pauses = [policy.seconds(["base"], now) - ALLOWANCE - 1.0 for now in (0.0, 4.0, 8.0, 19.0)]
    assert pauses == [0.25, 0.5, 1.0, 0.25]


def test_a_new_daemon_counts_anew(policy: ReturnPolicy) -> None:
    first = policy.seconds(["base"], 0.0)
    policy.daemon_restarted()
    assert policy.seconds(["base"], 1.0) == first


def test_the_pause_has_an_end(policy: ReturnPolicy) -> None:
    for _ in range(20):
        allowed = policy.seconds(["base"], 0.0)
    assert allowed == ALLOWANCE + 1.0 + LONGEST_BACKOFF


def test_only_modules_that_wait_for_each_other_add_up(policy: ReturnPolicy) -> None:
    assert policy.seconds([], 0.0) == ALLOWANCE
    assert policy.seconds(["base", "arm"], 0.0) == ALLOWANCE + 2 * 1.25
    policy.daemon_restarted()
    assert policy.seconds(["log", "base"], 0.0) == ALLOWANCE + 1.25 + 5.0
