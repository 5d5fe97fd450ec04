"""The tables of a database of MLflow's: looked at before MLflow is let in, which would change an older one unasked."""

from __future__ import annotations

import sqlite3
from functools import cache, partial
from pathlib import Path

import mlflow
from alembic.script import ScriptDirectory  # MLflow depends on alembic and on sqlalchemy
from sqlalchemy import create_engine, inspect, make_url, text
from sqlalchemy.pool import NullPool

from study.errors import BadInputError

MIGRATIONS = Path(mlflow.__file__).parent / "store" / "db_migrations"
CONNECT = {"connect_timeout": 10}  # [s]; left alone, PostgreSQL waits in silence for minutes


def has_tables(uri: str, shown: str, database: Path | None) -> bool:
    """Return whether a database has MLflow's tables, and write nothing. `database`: the file of a SQLite URI.

    Raises BadInputError when the tables are of another version of MLflow's, or of another program.
    """
    if database:
        connect = partial(sqlite3.connect, f"{database.as_uri()}?mode=ro", uri=True, timeout=20)
        engine = create_engine("sqlite://", creator=connect, poolclass=NullPool)
    else:
        url = make_url(uri)
        patient = url.get_backend_name() != "postgresql" or "connect_timeout" in url.query
        engine = create_engine(url, poolclass=NullPool, connect_args={} if patient else CONNECT)
    with engine.connect() as connection:
        tables = set(inspect(connection).get_table_names())
        if not tables and not database:
            return False
        if not {"experiments", "runs"} <= tables:
            raise BadInputError(
                f"{shown} is a database, but not MLflow's; give another {'file' if database else 'one'} with --tracking"
            )
        query = text("select version_num from alembic_version")
        version = connection.execute(query).scalar() if "alembic_version" in tables else None
    if version == _versions()[0]:
        return True
    if version is None or version in _versions():
        copy = f"cp {database} {database}.before" if database else "with your database's own tool"
        raise BadInputError(
            f"{shown} was written by an older MLflow (tables {version or 'without a version'}, {mlflow.__version__} "
            f"needs {_versions()[0]}) and is left as it is; copy it first ({copy}), then run: mlflow db upgrade {shown}"
        )
    raise BadInputError(
        f"{shown} was written by a newer MLflow (tables {version}, which {mlflow.__version__} does not know); "
        "use that version, or give another store with --tracking"
    )


@cache
def _versions() -> list[str]:
    """Return the versions of the tables that the installed MLflow knows, its own first."""
    return [script.revision for script in ScriptDirectory(str(MIGRATIONS)).walk_revisions()]
