"""What a file unpacks to, found out before it is unpacked: a stranger's log takes no more than a multiple of its size.

Compressed pieces are unpacked once to count their bytes, and SQLite files must be plain tables: views and computed
columns may run for ever or make gigabytes of nothing, as may pages that are met on several ways.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from contextlib import closing
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any

from ...utils.optional import require

# A robot at rest compresses a hundred times; what is small may always be unpacked.
_MOST, _FREE = 300, 2**24
# In bytes: what a message takes beside its own.
_OF_MESSAGE = 64
_PIECE = 2**20
_SQLITE, _MCAP, _ZSTD = b"SQLite format 3\0", b"\x89MCAP0\r\n", b"\x28\xb5\x2f\xfd"
_CHUNK = 0x06


class Allowance:
    """How many bytes may still come of a file.

    Parameters
    ----------
    size : int
        Of the file, bytes.
    """

    def __init__(self, size: int):
        self._left = _FREE + _MOST * size

    def take(self, n_bytes: int) -> None:
        """Count bytes; an error if there are too many."""
        self._left -= n_bytes
        if self._left < 0:
            raise ValueError(f"it unpacks to more than {_MOST} times its size")

    def take_all(self, stream: Any, copy: IO[bytes] | None = None) -> None:
        """Count the bytes of a stream, piece by piece."""
        while piece := stream.read(_PIECE):
            self.take(len(piece))
            if copy is not None:
                copy.write(piece)

    def messages(self, found: Iterable[tuple[Any, int, bytes]]) -> Iterator[tuple[Any, int, bytes]]:
        """Messages of rosbags, counted: parts of a file may be read many times."""
        for message in found:
            self.take(len(message[2]) + _OF_MESSAGE)
            yield message


def check_files(path: Path) -> int:
    """Refuse a recording, or a folder of them, that would unpack to far more than it is.

    Returns
    -------
    size : int
        Bytes of all.
    """
    files = [file for file in sorted(path.iterdir()) if file.is_file()] if path.is_dir() else [path]
    for file in files:
        with file.open("rb") as content:
            packed = content.read(4) == _ZSTD
            if packed:
                content.seek(0)
                with TemporaryDirectory() as folder, (unpacked := Path(folder, "unpacked")).open("wb") as copy:
                    Allowance(file.stat().st_size).take_all(_zstd().open(content, "rb"), copy)
                    copy.flush()
                    _check_content(unpacked)
        if not packed:
            _check_content(file)
    return sum(file.stat().st_size for file in files)


def check_storages(reader: Any, size: int) -> None:
    """Refuse an open reader of rosbags whose parts unpack to far more than they are."""
    storage, allowance = reader.storage, Allowance(size)
    for own in getattr(storage, "storages", [storage]):
        for chunk in getattr(own, "chunks", []):
            # What the index says, which need not be what is found on the way.
            allowance.take(chunk.uncompressed_size)
            own.bio.seek(chunk.chunk_start_offset + 9 + 40 + len(chunk.compression))
            if chunk.compression == "zstd":
                allowance.take_all(_zstd().open(BytesIO(own.bio.read(min(chunk.compressed_size, size))), "rb"))
        if reader.compression_mode == "message":
            for _, _, data in allowance.messages(own.messages(own.connections)):
                allowance.take_all(_zstd().open(BytesIO(data), "rb"))


def _zstd() -> Any:
    """The module that rosbags has it from, which depends on the version of Python."""
    return require("rosbags.rosbag2.storage_mcap", "Reading rosbag2 files").zstd


def _check_content(path: Path) -> None:
    with path.open("rb") as file:
        magic = file.read(16)
        if magic.startswith(_MCAP):
            _check_chunks(file, path.stat().st_size)
    if magic == _SQLITE:
        _check_database(path)


def _check_chunks(file: IO[bytes], size: int) -> None:
    """Of an MCAP file all chunks that are met when it is read from its beginning (https://mcap.dev/spec)."""
    allowance, place = Allowance(size), len(_MCAP)
    while place + 9 <= size:
        file.seek(place)
        kind, length = struct.unpack("<BQ", file.read(9))
        if length > size:
            raise ValueError(f"a record says that it has {length} bytes, and the file has {size}")
        if kind == _CHUNK:
            _, _, n_bytes, _, n_name = struct.unpack("<QQQII", _exactly(file, 32))
            name = _exactly(file, min(n_name, 16))
            allowance.take(n_bytes)
            if name == b"zstd":
                (n_packed,) = struct.unpack("<Q", _exactly(file, 8))
                allowance.take_all(_zstd().open(BytesIO(file.read(min(n_packed, size))), "rb"))
        place += 9 + length


def _exactly(file: IO[bytes], n_bytes: int) -> bytes:
    data = file.read(n_bytes)
    if len(data) != n_bytes:
        raise ValueError("a chunk ends too early")
    return data


def _check_database(path: Path) -> None:
    import sqlite3

    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?immutable=1", uri=True)) as database:
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(path.stat().st_size, _PIECE))
        database.execute("PRAGMA ignore_check_constraints=ON")
        for kind, name, sql in database.execute("SELECT type, name, sql FROM sqlite_master").fetchall():
            if kind not in ("table", "index") or str(sql).upper().startswith("CREATE VIRTUAL"):
                raise ValueError(f"its {name!r:.80} is no plain table ({sql!r:.80})")
            if any(hidden for (hidden,) in database.execute("SELECT hidden FROM pragma_table_xinfo(?)", [name])):
                raise ValueError(f"its table {name!r:.80} has computed columns")
        (state,) = database.execute("PRAGMA quick_check(1)").fetchone()
        if state != "ok":
            raise ValueError(f"SQLite finds it damaged: {state:.200}")
