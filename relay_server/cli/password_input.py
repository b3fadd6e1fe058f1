"""How passwords come in: typed unseen or by a pipe, never as an argument that a process list shows."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import click

from relay_protocol.errors import Invalid
from relay_server.auth import passwords

stdin_option: Callable[[Any], Any] = click.option(
    "--password-stdin", is_flag=True, help="Read the password from stdin, its first line."
)


def new_password_hash(from_stdin: bool) -> str:
    """Take a new password and return its hash.

    :raises Invalid: it breaks the rules, or nothing came
    """
    return passwords.hash_password(_piped() if from_stdin else _typed())


def _piped() -> str:
    line = sys.stdin.buffer.readline(passwords.MAX_BYTES + 3)
    try:
        text = line.decode()
    except UnicodeDecodeError:
        raise Invalid("the password on stdin is not UTF-8") from None
    text = text.removesuffix("\n").removesuffix("\r")
    if not text:
        raise Invalid("no password came on stdin; pipe one line into the command")
    return text


def _typed() -> str:
    text: str = click.prompt("Password", hide_input=True, confirmation_prompt=True, err=True)
    return text
