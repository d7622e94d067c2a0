"""Plain values as JSON files that any reader takes."""

import json
import math
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surrogates.files import write_whole


def write_json(path: Path, value: Any) -> None:
    """Write atomically; NaN and infinity become null, so that any JSON reader takes it."""
    write_whole(path, f"{json_text(value)}\n")


def json_text(value: Any) -> str:
    """What `write_json` writes."""
    return json.dumps(json_values(value), indent=2, allow_nan=False)


def json_values(value: Any) -> Any:
    """Plain JSON values: dataclasses to objects, tuples and arrays to lists, NumPy scalars to
    numbers, what is not finite to None."""
    if is_dataclass(value):
        value = vars(value)
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): json_values(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_values(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
