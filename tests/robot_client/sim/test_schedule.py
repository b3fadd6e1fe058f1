"""Regular tasks on an injected clock."""

from robot_client.sim.schedule import Schedule


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_tasks_run_at_their_own_rates() -> None:
    clock, done = Clock(), {"fast": 0, "slow": 0}
    schedule = Schedule(clock)
    for name, rate in (("fast", 50), ("slow", 15)):
        schedule.every(1 / rate, lambda name=name: done.__setitem__(name, done[name] + 1))
    for millisecond in range(1000):
        clock.now = millisecond / 1000
        schedule.run_due()
    assert done == {"fast": 50, "slow": 15}


def test_run_due_returns_the_time_until_the_next_task() -> None:
    clock = Clock()
    schedule = Schedule(clock)
    schedule.every(0.5, lambda: None)
    schedule.every(0.2, lambda: None)
    assert schedule.run_due() == 0.2


def test_missed_runs_are_made_up_within_bounds() -> None:
    clock, done = Clock(), []
    schedule = Schedule(clock)
    schedule.every(0.02, lambda: done.append(clock.now), catch_up=5)
    schedule.run_due()
    clock.now = 0.065
    schedule.run_due()
    assert len(done) == 4
    clock.now = 10.0
    schedule.run_due()
    assert len(done) <= 9
    assert schedule.run_due() <= 0.02
