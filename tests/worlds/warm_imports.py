"""Imports what our programs import, so that those forked afterwards start at once; see :mod:`forked_programs`."""

from __future__ import annotations

import contextlib
import gc
import pkgutil
from importlib import import_module

from rosidl_generator_py import import_type_support

import relay_db.queries
import relay_server
from relay_server.auth.passwords import prepare
from relay_server.http.openapi.http import DocumentEndpoints
from relay_server.http.static_files import Portal
from robot_client.sim.floor_plan import floor_plan
from robot_client.sim.world import WORLDS
from tests.worlds.empty_database import empty_database

# Not all of robot_client: with it, rclpy.init() hangs in forked programs.
PROGRAMS = (
    "robot_client.cli",
    "robot_client.mqtt_gateway",
    "robot_client.platforms.ros2.platform",
    "robot_client.run",
    "robot_client.services.main",
    "robot_client.sim.main",
    "robot_client.sim.node",
    *("av", "websockets.server"),  # for the portal's fake relay
)
INTERFACES = (
    "builtin_interfaces",
    "diagnostic_msgs",
    "geometry_msgs",
    "nav_msgs",
    "rcl_interfaces",
    "sensor_msgs",
    "service_msgs",
    "std_msgs",
    "std_srvs",
    "tf2_msgs",
    "type_description_interfaces",
)

for package in (relay_db, relay_server):
    for found in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        # Migrations are imported by Alembic alone, as below.
        if not found.name.endswith(".__main__") and not found.name.startswith("relay_db.migrations"):
            import_module(found.name)

for name in PROGRAMS:
    import_module(name)

for package_name in INTERFACES:
    with contextlib.suppress(ImportError):
        import_type_support(package_name)

empty_database()
prepare()
DocumentEndpoints(relay_server.VERSION, "cookie")
Portal(relay_server.PORTAL)
for world in WORLDS.values():
    floor_plan(world())

# Collecting garbage in a forked program would copy the memory it shares with this one.
gc.collect()
gc.freeze()
