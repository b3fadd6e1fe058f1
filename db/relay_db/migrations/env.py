"""Run by Alembic within the transaction that :mod:`relay_db.schema` opened."""

from __future__ import annotations

from alembic import context

from relay_db.base import Base

connection = context.config.attributes.get("connection")
if connection is None:
    raise RuntimeError(
        "migrations run through relay_db.engine.Database.upgrade(), which brings the connection"
    )

context.configure(
    connection=connection, target_metadata=Base.metadata, transactional_ddl=True, render_as_batch=True
)
with context.begin_transaction():
    context.run_migrations()
