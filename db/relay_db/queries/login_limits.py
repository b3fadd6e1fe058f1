"""Failed logins by account, and the networks that a user has logged in from."""

from __future__ import annotations

from sqlalchemy import delete, func, insert, select, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from relay_db.models import LABEL, LoginFailure, LoginNetwork

NETWORKS = 16
"""The latest networks that are remembered of each user."""


def login_failures(s: Session, account: str, now: float) -> list[float]:
    """Unix seconds at which the failures of an account expire. Others wait that count failures of this account.

    :param account: SHA-256 in hex of its name
    """
    if s.get_bind().dialect.name == "postgresql":
        s.execute(select(func.pg_advisory_xact_lock(int(account[:15], 16))))
    counted = LoginFailure.account == account, LoginFailure.expires > now
    return list(s.scalars(select(LoginFailure.expires).where(*counted)))


def add_login_failure(s: Session, account: str, expires: float) -> int:
    """Count a failure; returns its number.

    :param expires: Unix seconds
    """
    values = insert(LoginFailure).values(account=account, expires=expires)
    return s.scalars(values.returning(LoginFailure.id)).one()


def remove_login_failure(s: Session, number: int) -> None:
    """Take a failure back."""
    s.execute(delete(LoginFailure).where(LoginFailure.id == number))


def last_login_from(s: Session, user_id: int, network: str) -> float | None:
    """Unix seconds of about the last login of a user from a network; ``None``: not remembered."""
    found = LoginNetwork.user_id == user_id, LoginNetwork.network == network[:LABEL]
    return s.scalar(select(LoginNetwork.at).where(*found))


def remember_login_network(s: Session, user_id: int, network: str, now: float) -> None:
    """A user logs in from a network. Only the latest :data:`NETWORKS` are kept; nothing is done without the user."""
    network = network[:LABEL]
    found = LoginNetwork.user_id == user_id, LoginNetwork.network == network
    changed = update(LoginNetwork).where(*found).values(at=now).returning(LoginNetwork.at)
    if s.scalar(changed) is not None:
        return
    try:
        with s.begin_nested():
            s.execute(insert(LoginNetwork).values(user_id=user_id, network=network, at=now))
    except IntegrityError:
        return
    own = LoginNetwork.user_id == user_id
    oldest = (
        select(LoginNetwork.network)
        .where(own)
        .order_by(LoginNetwork.at.desc(), LoginNetwork.network)
        .offset(NETWORKS)
    )
    s.execute(delete(LoginNetwork).where(own, LoginNetwork.network.in_(s.scalars(oldest).all())))
