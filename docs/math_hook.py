"""For MkDocs: ```math blocks of LaTeX as MathML, which browsers set without a script or a font."""

import re
from typing import Any

BLOCK = re.compile(r"^```math\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """The page with its formulas; an error of LaTeX ends the build."""
    from latex2mathml.converter import convert  # of the site alone

    return BLOCK.sub(lambda m: f"<div>{convert(m[1].strip(), display='block')}</div>", markdown)
