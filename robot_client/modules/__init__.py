"""Modules: processes that the daemon starts, watches, restarts and stops. Three processes take part:

1. The daemon decides: which modules are to run, and when one is started again (``supervisor``, ``states``).
2. A runner for each module starts the program, keeps its output and ends its descendants (``runner``, ``log_ring``).
3. The program: a command, ``ros2 launch``, or ``robot_client.devices.host`` with a Python class.

A run is one life of a runner and its program; ``module_run`` is the daemon's side of it. Runners outlive a daemon that
dies, and the next daemon reconnects to them.

Where to look:

- a setting: ``settings``; what it does to the process: ``module_run.run_spec`` and ``runner``
- when a module is started, is ready or has failed: ``states``, ``supervisor``, ``readiness``
- how its end is put into words: ``module_exit``; the nodes and errors of ``ros2 launch``: ``launched_nodes``
- its output: ``module_output`` bounds it, ``log_ring`` keeps it
- orders: ``relay_requests`` of the relay, ``local_orders`` of ``switchboard-robot module``, ``command_relay`` of other
  modules to a Python class
- the monitor: ``process_table``; how processes are found and killed: ``processes``
"""
