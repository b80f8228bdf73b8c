"""Databases of ours: what else they may hold is refused, values and queries have limits."""

import sqlite3

import pytest

from skyquilt import outside
from skyquilt.errors import OutputError
from skyquilt.raster.database import open_database

TABLES = """
create table if not exists a(x integer primary key, y text not null);
create index if not exists a_y on a(y);
"""


def foreign(path, *statements):
    with sqlite3.connect(path) as db:
        for statement in statements:
            db.execute(statement)
    db.close()
    return path


def test_it_is_made_and_opened_again(tmp_path):
    db = open_database(tmp_path / "a.db", TABLES, write=True)
    db.execute("insert into a values (1, 'x')")
    assert db.execute("pragma synchronous").fetchone() == (2,)
    reader = open_database(tmp_path / "a.db", TABLES, write=False)
    assert reader.execute("select * from a").fetchall() == [(1, "x")]
    with pytest.raises(sqlite3.OperationalError):
        reader.execute("insert into a values (2, 'x')")
    db.close()
    open_database(tmp_path / "a.db", TABLES.replace(" text", "  TEXT"), write=True).close()


@pytest.mark.parametrize(
    "statement",
    [
        "create view a as select 1",
        "create table a(x integer primary key, y text)",
        "create table a(x integer primary key, y text not null, z as (x * 2))",
        "create table a(x integer primary key, y text not null check(length(y) < 9))",
        "create temp table b(x)",  # not in the file: nothing to refuse
        "create trigger t after insert on a begin delete from a; end",
        "create table b(x)",
    ],
)
@pytest.mark.parametrize("write", [True, False])
def test_what_is_none_of_ours_is_refused(tmp_path, statement, write):
    path = tmp_path / "a.db"
    if "trigger" in statement or "temp" in statement:
        open_database(path, TABLES, write=True).close()
    foreign(path, statement)
    if "temp" in statement:
        open_database(path, TABLES, write=write).close()
        return
    with pytest.raises(OutputError, match="none of Skyquilt's"):
        open_database(path, TABLES, write=write)


def test_queries_and_values_have_limits(tmp_path, monkeypatch):
    db = open_database(tmp_path / "a.db", TABLES, write=True)
    monkeypatch.setattr(outside, "MOST_QUERY_S", 0.2)
    endless = "with recursive c(x) as (select 1 union all select x + 1 from c) select max(x) from c"
    with pytest.raises(sqlite3.OperationalError, match="interrupted"):
        db.execute(endless).fetchone()
    with pytest.raises(sqlite3.DataError, match="too big"):
        db.execute("select zeroblob(257000000)").fetchone()
    assert db.execute("select count(*) from a").fetchone() == (0,)
