"""The explorer: what its sliders say, the certified designs there, their curves, and the page.

Everything but `page` and `server` is free of any server library.
"""

from ccd_casadi.support.extensions import Extension

ASSETS = "extensions/explorer/assets"
EXTENSION = Extension(
    commands={
        "explore": (
            "ccd_casadi.extensions.explorer.explore_command",
            "drag the hardware and see the certified loop move",
        )
    }
)
