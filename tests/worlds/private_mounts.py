"""Mounts that only one program and its children see, such as a small disk or a read-only one."""

from __future__ import annotations

import functools
import subprocess

import pytest

OPTIONS = ("-Urm", "-m")
"""Of unshare(1): in a user namespace, which any user may have; without one, which only root may."""


@functools.cache
def with_private_mounts() -> list[str]:
    """A program and its arguments that run a further one with mounts of its own.

    Skips the test where the kernel allows neither, as in a container without CAP_SYS_ADMIN whose seccomp filter
    refuses namespaces. There other tests put a limit on the size of files in the disk's place.
    """
    for each in OPTIONS:
        command = ["unshare", each]
        tried = [*command, "mount", "-t", "tmpfs", "tmpfs", "/tmp"]
        if subprocess.run(tried, check=False, capture_output=True).returncode == 0:
            return command
    pytest.skip("the kernel allows no mounts of its own: neither a user namespace nor CAP_SYS_ADMIN")
