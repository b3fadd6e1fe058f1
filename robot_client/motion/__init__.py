"""All that moves or stops the robot.

A command enters at ``motion_control`` (:meth:`MotionControl.command`): ``authority`` (whose), ``command_age`` (how
old), ``speed_limiter`` (how fast), then the platform; ``watchdog`` and ``guard`` stop what ends. Goals enter
at ``goal_topics`` and ``request_gate``.

Orders of the relay enter at ``order_handler``. A stop does all of this at once, and is answered when all has ended:

1. ``authority`` refuses further commands and goals,
2. ``topic_stopper`` publishes zero where clients commanded,
3. the channels cancel the goals of clients,
4. modules are notified (``robot_client.modules``),
5. ``hardware`` sets the switches,
6. ``goal_canceller`` cancels goals of other nodes, ``graph_zero_publisher`` publishes zero where other nodes command,
7. ``stop_store`` writes it to disk, so that it outlives the daemon.

A ``…_port`` is an interface.
"""
