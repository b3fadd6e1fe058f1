"""What all tests share."""

from __future__ import annotations

import switchboard_processes

switchboard_processes.forking = True
