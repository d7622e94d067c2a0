"""For MkDocs: ```math blocks of LaTeX as MathML, which browsers set without a script or a font."""

import re
from typing import Any

BLOCK = re.compile(r"^```math\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """The page with its formulas; an error of LaTeX ends the build."""
    from latex2mathml.converter import convert  # of the site alone

    def block(found: re.Match[str]) -> str:
        return f'<div class="formula">{convert(found[1].strip(), display="block")}</div>'

    return BLOCK.sub(block, markdown)
