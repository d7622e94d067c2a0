"""What the paper publishes of its case studies, to stand beside ours (`published.json`).

Wu and Zhou, Control Co-design of Actively Controlled Lightweight Structures for
High-acceleration Precision Motion Systems (2022): table 3, figures 4 and 5; table 4.
"""

import json
from typing import Any

from ccd_casadi.support.package_text import package_text

PUBLISHED: dict[str, dict[str, Any]] = json.loads(package_text("studies/published.json"))
