"""What Switchboard costs, measured side by side with alternatives: ``python -m bench``, see ``bench/README.md``."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BUILD = ROOT / "build" / "bench"
RESULTS = ROOT / "bench" / "results"
