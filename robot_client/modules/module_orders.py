"""Orders to modules, on disk for the daemons that come after this one in the same boot of the machine."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import msgspec


class LatestOrder(msgspec.Struct, frozen=True):
    """The latest order to a module.

    :param wanted: whether it is to run
    :param autostart: that of the settings when the order was given; the order holds until it is changed
    """

    wanted: bool
    autostart: bool


class _SavedOrders(msgspec.Struct):
    """
    :param boot: id of the boot of the machine in which they were given
    """

    boot: str
    orders: dict[str, LatestOrder]


def read_orders(path: Path, boot: str) -> dict[str, LatestOrder]:
    """The orders of this boot by module; none if the file is missing or damaged.

    :param boot: id of this boot of the machine
    """
    try:
        saved = msgspec.json.decode(path.read_bytes(), type=_SavedOrders)
    except (OSError, msgspec.DecodeError):
        return {}
    return saved.orders if saved.boot == boot else {}


def write_orders(path: Path, boot: str, orders: Mapping[str, LatestOrder]) -> None:
    """Replace the orders on disk.

    :param boot: id of this boot of the machine
    :raises OSError: they can't be written; those before stay
    """
    new = path.with_suffix(".new")
    new.write_bytes(msgspec.json.encode(_SavedOrders(boot, dict(orders))))
    new.replace(path)
