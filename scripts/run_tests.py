"""Run pytest, and give the few tests that fail a second chance. Run by ``make test``.

If tests of at most :data:`MOST_FILES` files failed, they run once more, alone, one after another. Those that pass then
are listed as flaky at the end and in ``build/flaky.txt``, one a line; they do not fail the run, and each of them needs
mending.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FLAKY = ROOT / "build" / "flaky.txt"
LAST_FAILED = ROOT / ".pytest_cache" / "v" / "cache" / "lastfailed"
MOST_FILES = 10
"""A fixture that fails makes all tests of its file fail, so files are counted."""

TESTS_FAILED = 1
"""The exit code of pytest for failed tests; others are errors of the run itself, such as an unknown option."""


def main(options: list[str]) -> int:
    """Run the tests.

    :param options: options of pytest for the first run: workers, a selection
    :returns: the exit code: 0 if each test passed in the first or in the second run
    """
    FLAKY.parent.mkdir(exist_ok=True)
    FLAKY.write_text("")
    code = _pytest("--cache-clear", *options)
    failed = _failed()
    if code != TESTS_FAILED or len({test.partition("::")[0] for test in failed}) > MOST_FILES:
        return code
    sys.stdout.write(f"\nOnce more, alone, one after another: {len(failed)} failed tests\n")
    sys.stdout.flush()
    code = _pytest("--last-failed", "--last-failed-no-failures=none", "--numprocesses=0")
    # Pytest keeps a test that failed until it passes, also if it is not found in the second run.
    still_failed = _failed()
    flaky = sorted(failed - still_failed)
    FLAKY.write_text("".join(f"{test}\n" for test in flaky))
    for test in flaky:
        sys.stdout.write(f"flaky: {test}\n")
    return code or int(bool(still_failed))


def _pytest(*options: str) -> int:
    return subprocess.run([sys.executable, "-m", "pytest", *options], cwd=ROOT, check=False).returncode


def _failed() -> set[str]:
    """Tests that failed when they ran last, by node id."""
    return set(json.loads(LAST_FAILED.read_text())) if LAST_FAILED.exists() else set()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
