"""Settings for these tests."""

from hypothesis import settings

# A machine that is busy with something else must not fail a test.
settings.register_profile("unhurried", deadline=None)
settings.load_profile("unhurried")
