"""What Switchboard costs, measured side by side with alternatives: ``python -m bench``, see ``bench/README.md``."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BUILD = ROOT / "build" / "bench"
RESULTS = ROOT / "bench" / "results"

# The harness starts relays, daemons and robots for the end-to-end tests; it is no package.
sys.path.insert(0, str(ROOT / "tests" / "harness"))
