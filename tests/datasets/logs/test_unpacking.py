"""Files that would unpack to far more than they are; `tests/long/hostile_files.py` has thousands of others."""

import gzip
import shutil
import sqlite3
import struct
import tracemalloc
from contextlib import closing

import numpy as np
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import zstd

from skevgp.datasets import load_log

from .cases import BY_NUMBER, irregular_times, table_of, write_table
from .test_bags import START, STATES, STORE, UR10, assert_recorded, state, states

RATIO = "it unpacks to more than 300 times its size"
ZEROS = bytes(2**27)


def refused(path, message, columns=None):
    """Refused, in less memory than the file would unpack to."""
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=rf"{path.name}: .*{message}"):
            load_log(path, columns=columns)
        assert tracemalloc.get_traced_memory()[1] < 2**26
    finally:
        tracemalloc.stop()


def compressed(folder, mode, plugin=StoragePlugin.MCAP, messages=None):
    writer = Writer(folder, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/joint_states", STATES, typestore=STORE)
        for received, message in messages or states():
            writer.write(connection, received, STORE.serialize_cdr(message, STATES))
    return folder


@pytest.mark.parametrize(
    ("mode", "plugin"),
    [
        (CompressionMode.STORAGE, StoragePlugin.MCAP),
        (CompressionMode.FILE, StoragePlugin.SQLITE3),
        (CompressionMode.MESSAGE, StoragePlugin.SQLITE3),
    ],
    ids=["chunks", "file", "messages"],
)
def test_compressed_recordings_are_read(tmp_path, mode, plugin):
    assert_recorded(load_log(compressed(tmp_path / "bag", mode, plugin)))


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE], ids=["file", "messages"])
def test_folders_that_unpack_to_far_more_than_they_are(tmp_path, mode):
    folder = compressed(tmp_path / "bag", mode, StoragePlugin.SQLITE3)
    if mode is CompressionMode.FILE:
        next(folder.glob("*.zstd")).write_bytes(zstd.compress(ZEROS))
    else:
        with closing(sqlite3.connect(next(folder.glob("*.db3")))) as database:
            database.execute("UPDATE messages SET data = ?", [zstd.compress(ZEROS)])
            database.commit()
    refused(folder, RATIO)


def test_a_table_that_unpacks_to_far_more_than_it_is(tmp_path):
    path = tmp_path / "log.csv.gz"
    path.write_bytes(gzip.compress(b"0,0,0,0,0,0,0,0\n" * 2**22))
    refused(path, RATIO, BY_NUMBER)


def test_a_table_of_rest_is_none_of_them(tmp_path):
    """What is constant compresses well."""
    table = table_of(irregular_times(3.0))
    path = write_table(tmp_path / "log.csv.gz", np.hstack([table, np.zeros((len(table), 200))]))
    load_log(path, columns=BY_NUMBER)


def chunk(n_bytes, packed, name=b"zstd"):
    body = struct.pack("<QQQI", 0, 1, n_bytes, 0) + struct.pack("<I", len(name)) + name
    body += struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", 6, len(body)) + body


HEADER = b"\x89MCAP0\r\n" + struct.pack("<BQ", 1, 12) + struct.pack("<I4sI", 4, b"ros2", 0)
FOOTER = struct.pack("<BQQQI", 2, 20, 0, 0, 0) + b"\x89MCAP0\r\n"


@pytest.mark.parametrize("said", [len(ZEROS), 100], ids=["as it says", "more than it says"])
def test_an_mcap_chunk_that_unpacks_to_far_more_than_it_is(tmp_path, said):
    path = tmp_path / "log.mcap"
    path.write_bytes(HEADER + chunk(said, zstd.compress(ZEROS)) + FOOTER)
    refused(path, RATIO)


def test_an_mcap_record_that_is_longer_than_its_file(tmp_path):
    path = tmp_path / "log.mcap"
    path.write_bytes(HEADER + struct.pack("<BQ", 3, 2**40) + FOOTER)
    refused(path, "a record says that it has 1099511627776 bytes, and the file has")


def test_a_chunk_that_the_index_has_many_times(tmp_path):
    """Its messages would be read as often: quadratic in the size of the file."""
    names = [f"joint{number}" for number in range(50)]
    numbers = np.zeros(50)
    messages = [(START + 1000 * t, state(START + 1000 * t, names, numbers, (), numbers)) for t in range(4000)]
    path = next(compressed(tmp_path / "bag", CompressionMode.STORAGE, messages=messages).glob("*.mcap"))
    data = path.read_bytes()
    (summary,) = struct.unpack("<Q", data[-28:-20])
    place = summary
    while data[place] != 8:
        place += 9 + struct.unpack("<Q", data[place + 1 : place + 9])[0]
    index = data[place : place + 9 + struct.unpack("<Q", data[place + 1 : place + 9])[0]]
    again = tmp_path / "log.mcap"
    again.write_bytes(data[:place] + index * 400 + data[place:])
    refused(again, RATIO)


ENDLESS = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT count(*) AS schema_version FROM c"


@pytest.mark.parametrize(
    ("script", "message"),
    [
        (f"CREATE VIEW schema AS {ENDLESS}", "its 'schema' is no plain table"),
        (
            "ALTER TABLE messages RENAME COLUMN data TO old;"
            "ALTER TABLE messages ADD COLUMN data AS (zeroblob(900000000))",
            "its table 'messages' has computed columns",
        ),
        ("ALTER TABLE messages RENAME TO old; CREATE VIEW messages AS SELECT * FROM old", "is no plain table"),
        ("CREATE VIRTUAL TABLE more USING fts5(x)", "is no plain table"),
        ("CREATE TRIGGER t AFTER INSERT ON messages BEGIN SELECT 1; END", "is no plain table"),
    ],
    ids=["endless", "computed", "view", "virtual", "trigger"],
)
def test_a_database_is_plain_tables(tmp_path, script, message):
    path = shutil.copy(UR10, tmp_path / "log.db3")
    with closing(sqlite3.connect(path)) as database:
        database.executescript(f"DROP TABLE IF EXISTS schema; {script}" if "schema" in script else script)
    refused(path, message)


def test_a_database_whose_pages_are_met_twice(tmp_path):
    """Rows of one page would be read as often as it is met."""
    data = bytearray(UR10.read_bytes())
    size = int.from_bytes(data[16:18], "big")
    pages = range(size, len(data), size)
    tree = next(page for page in pages if data[page] == 5 and int.from_bytes(data[page + 3 : page + 5], "big") > 1)
    cells = [int.from_bytes(data[tree + 12 + 2 * i : tree + 14 + 2 * i], "big") for i in range(2)]
    data[tree + cells[1] : tree + cells[1] + 4] = data[tree + cells[0] : tree + cells[0] + 4]
    path = tmp_path / "log.db3"
    path.write_bytes(data)
    refused(path, "SQLite finds it damaged: ")


def test_values_of_any_size_are_told(tmp_path):
    table = table_of(irregular_times(3.0))
    table[100, 6] = 1e308  # a position would be cut out as a jump
    path = write_table(tmp_path / "log.csv", table)
    with pytest.raises(ValueError, match=r"log\.csv: its \w+ overflows when it is filtered and differentiated"):
        load_log(path, columns=BY_NUMBER)
