"""Everything that keeps a robot still: authority, watchdog, guard, limits, goals, stop."""
