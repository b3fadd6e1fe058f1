"""Settings of the fuzz tests; ``HYPOTHESIS_PROFILE=protocol-long`` runs many more examples."""

from __future__ import annotations

import os

from hypothesis import HealthCheck, settings

# Time per example says more about what else the machine does than about the code.
settings.register_profile("protocol", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("protocol-long", settings.get_profile("protocol"), max_examples=3000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "protocol"))
