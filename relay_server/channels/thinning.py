"""Thinning of point clouds: what several subscriptions request together."""

from __future__ import annotations

from collections.abc import Iterable

from relay_protocol import link


def least_thinning(requests: Iterable[link.Thinning | None]) -> link.Thinning | None:
    """The thinning that leaves every request the points it wants; ``None``: no thinning.

    A grid and a stride have no points in common in general, so both together need all points.
    """
    found = list(requests)
    wanted = [each for each in found if each is not None and each.thins]
    if not wanted or len(wanted) < len(found):
        return None
    if all(each.voxel > 0 for each in wanted):
        return link.Thinning(voxel=min(each.voxel for each in wanted))
    if any(each.voxel > 0 for each in wanted):
        return None
    return link.Thinning(stride=min(each.stride for each in wanted))
