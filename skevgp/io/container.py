"""The container of a file: a zip archive, not compressed, of one JSON text and arrays in NumPy's own format.

It can be opened with any zip program, and its arrays by ``numpy.load``. Reading takes no more memory than a multiple of
the file, whatever the file says: nothing in it is compressed, members together are no longer than the file, and the
size of an array is compared with the bytes that are there before it is made.
"""

from __future__ import annotations

import json
import os
import re
from io import BytesIO
from typing import IO, Any
from zipfile import ZIP_STORED, ZipFile, ZipInfo

import numpy as np

from .fields import MalformedError

TEXT = "model.json"
# Of the JSON text: its objects take some thirty times as much memory.
_LONGEST_TEXT = 2**26
_MAGIC = b"\x93NUMPY\x01\x00"
_HEADER = re.compile(
    rb"\{'descr': '([<|](?:b1|[iu][1248]|f[248]))', 'fortran_order': (True|False), 'shape': \(([0-9, ]*)\), \} *\n"
)
_ENCRYPTED = 0x1
_PIECE = 2**20


def write(file: IO[bytes], content: Any, arrays: list[np.ndarray]) -> None:
    """Write a JSON text and arrays; what is the same has the same bytes.

    Raises
    ------
    ValueError
        If the text is too long.
    """
    text = json.dumps(content, allow_nan=False, separators=(",", ":")).encode()
    if len(text) > _LONGEST_TEXT:
        raise ValueError(f"The model's structure takes {len(text)} bytes, but a file has {_LONGEST_TEXT} for it.")
    with ZipFile(file, "w", ZIP_STORED) as archive:
        archive.writestr(ZipInfo(TEXT), text)
        for number, values in enumerate(arrays):
            buffer = BytesIO()
            np.lib.format.write_array(buffer, values, version=(1, 0), allow_pickle=False)
            archive.writestr(ZipInfo(_member(number)), buffer.getbuffer())


def _member(number: int) -> str:
    return f"{number}.npy"


class Container:
    """A file that is being read.

    Parameters
    ----------
    file : binary file
        That can be searched.

    Raises
    ------
    MalformedError
        If it is no zip archive, or one that `write` does not make.
    """

    def __init__(self, file: IO[bytes]):
        size = file.seek(0, os.SEEK_END)
        self._archive = ZipFile(file)
        self._members: dict[str, ZipInfo] = {}
        for info in self._archive.infolist():
            if info.filename in self._members:
                raise MalformedError(f"it has two members of the name {info.filename!r}")
            if info.compress_type != ZIP_STORED or info.compress_size != info.file_size:
                raise MalformedError(f"its member {info.filename!r} is compressed, which no such file is")
            if info.flag_bits & _ENCRYPTED:
                raise MalformedError(f"its member {info.filename!r} is encrypted")
            self._members[info.filename] = info
        if sum(info.file_size for info in self._members.values()) > size:
            raise MalformedError("its members together are longer than the file")
        self._arrays: dict[int, np.ndarray] = {}

    def text(self) -> Any:
        """What its JSON text says."""
        info = self._info(TEXT)
        if info.file_size > _LONGEST_TEXT:
            raise MalformedError(f"its {TEXT} is longer than {_LONGEST_TEXT} bytes")
        text = self._archive.read(info)
        return json.loads(text, object_pairs_hook=_once, parse_constant=_no_constant)

    def array(self, number: int) -> np.ndarray:
        """One of its arrays: the same object each time."""
        if number not in self._arrays:
            info = self._info(_member(number))
            with self._archive.open(info) as file:
                self._arrays[number] = _array_in(file, info)
        return self._arrays[number]

    @property
    def n_arrays(self) -> int:
        """How many it has."""
        return len(self._members) - 1

    def _info(self, name: str) -> ZipInfo:
        if name not in self._members:
            raise MalformedError(f"it has no member {name!r}")
        return self._members[name]


def _array_in(file: IO[bytes], info: ZipInfo) -> np.ndarray:
    start = file.read(len(_MAGIC) + 2)
    length = int.from_bytes(start[len(_MAGIC) :], "little")
    header = _HEADER.fullmatch(file.read(length)) if start.startswith(_MAGIC) else None
    if header is None:
        raise MalformedError(f"its member {info.filename!r} is not an array of numbers as numpy.save writes one")
    dtype = np.dtype(header[1].decode())
    shape = tuple(int(size) for size in header[3].replace(b" ", b"").split(b",") if size)
    # Python's integers: they do not overflow.
    n_bytes = dtype.itemsize
    for size in shape:
        n_bytes *= size
    if n_bytes != info.file_size - len(start) - length or len(shape) > 32:
        raise MalformedError(f"its member {info.filename!r} says the shape {shape}, which are not the bytes it has")
    values = np.empty(shape, dtype, order="F" if header[2] == b"True" else "C")
    # A transposed view has the bytes in their order.
    flat: Any = (values.T if header[2] == b"True" else values).reshape(-1)
    target = memoryview(flat).cast("B") if n_bytes else memoryview(bytearray())
    place = 0
    while piece := file.read(_PIECE):
        target[place : place + len(piece)] = piece
        place += len(piece)
    if place != n_bytes:
        raise MalformedError(f"its member {info.filename!r} ends too early")
    if dtype.kind == "b" and (values.view(np.uint8) > 1).any():
        raise MalformedError(f"its member {info.filename!r} has truth values that are neither 0 nor 1")
    return values


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise MalformedError(f"its {TEXT} has a name twice among {[name for name, _ in pairs][:10]}")
    return found


def _no_constant(name: str) -> None:
    raise MalformedError(f"its {TEXT} has {name}, which is not JSON")
