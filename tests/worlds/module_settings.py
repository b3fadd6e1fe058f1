"""Settings of a robot with two modules: ``base`` starts with the daemon, ``cleaning`` by order."""

from __future__ import annotations

import sys

_PYTHON = f'"{sys.executable}", "-u", "-c"'
MODULES = f"""
[[module]]
name = "base"
command = [{_PYTHON}, "import time; print('base is up'); time.sleep(600)"]
ready_log = "is up"
term_after_s = 0.5
kill_after_s = 0.5

[[module]]
name = "cleaning"
command = [{_PYTHON}, '''
import time
for number in range(10**6): print("[WARN] [1.5] [cleaner]: swept", number); time.sleep(0.2)
''']
after = ["base"]
autostart = false
term_after_s = 0.5
kill_after_s = 0.5
"""
