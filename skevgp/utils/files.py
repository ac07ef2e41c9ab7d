"""Files that are written completely or not at all."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[IO[bytes]]:
    """Open a new file that replaces ``path`` when all is written, and is deleted if that fails."""
    # A concurrent reader sees the old file or the new one. Of several writers, the last one wins.
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        # A pipe or a device is not replaced.
        with open(path, "wb") as file:
            yield file
        return
    beside = target.with_name(f".{secrets.token_hex(8)}.tmp")
    try:
        with open(beside, "xb+") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if target.exists():
            shutil.copymode(target, beside)
        os.replace(beside, target)
    except OSError as error:
        if error.filename != str(beside) and error.filename != beside:
            raise
        # Name the file that the user gave.
        raise OSError(error.errno, error.strerror, os.fspath(path)) from None
    finally:
        with suppress(OSError):
            beside.unlink(missing_ok=True)
