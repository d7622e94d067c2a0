"""A log of JSON lines that several jobs may append to, and that a kill cannot spoil."""

import json
import math
import os
from pathlib import Path
from typing import Any


class Journal:
    """One JSON object a line; every line is written at once."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def append(self, **entry: Any) -> None:
        """Add an object; what is not finite becomes null."""
        line = json.dumps(_plain(entry), allow_nan=False).encode() + b"\n"
        flags = os.O_RDWR | os.O_APPEND | os.O_CREAT
        descriptor = os.open(self.path, flags, 0o666)
        try:
            size = os.fstat(descriptor).st_size
            if size and os.pread(descriptor, 1, size - 1) != b"\n":  # cut short by a full disk
                line = b"\n" + line
            os.write(descriptor, line)
        finally:
            os.close(descriptor)

    def entries(self) -> list[dict[str, Any]]:
        """All objects so far; lines that are none are left out."""
        found = []
        if self.path.exists():
            for line in self.path.read_bytes().splitlines():
                try:
                    entry = json.loads(line)
                except ValueError:
                    continue
                if isinstance(entry, dict):
                    found.append(entry)
        return found


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value
