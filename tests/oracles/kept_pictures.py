"""Pictures that browser tests make of what they judge, for a person to look at.

    PICTURES=DIR python -m pytest tests/pages

writes DIR/NAME.png for each name below; without PICTURES none is made.
"""

import os
from pathlib import Path
from typing import Any


def picture(page: Any, name: str, whole: bool = False) -> None:
    """What the window shows, or the whole page."""
    if place := os.environ.get("PICTURES"):
        Path(place).mkdir(parents=True, exist_ok=True)
        page.screenshot(path=Path(place) / f"{name}.png", full_page=whole)
