"""What the paper publishes of its case studies, to stand beside ours.

Wu and Zhou, Control Co-design of Actively Controlled Lightweight Structures for
High-acceleration Precision Motion Systems (2022): table 3, figures 4 and 5; table 4.
"""

from typing import Any

TWO_MASS: dict[str, Any] = {
    "sequential": {
        "theta": {"m1": 67.56, "m2": 67.56},
        "hardware_cost": 135.12,
        "bandwidth_hz": 54.1,
        "objective": -325.1,
        "first_resonance_hz": 250.0,
    },
    "nested_ccd": {
        "theta": {"m1": 58.33, "m2": 55.0},
        "hardware_cost": 113.33,
        "bandwidth_hz": 71.8,
        "objective": -437.6,
        "first_resonance_hz": 192.6,
    },
    "plant_60_60": {"antiresonance_hz": 147.0, "resonance_hz": 209.0},
    "case_A": {"M_K": 2e7, "bandwidth_hz": 57.0, "peak_hz": 120.0},
    "case_B": {"M_K": 0.5e7, "bandwidth_hz": 32.0, "peak_hz": 84.0},
}

RIB_STAGE: dict[str, Any] = {
    "sequential": {
        "hardware_cost": 1.02,
        "bandwidth_hz": 55.7,
        "objective": -10.65,
        "first_resonance_hz": 250.0,
    },
    "nested_ccd": {
        "hardware_cost": 0.59,
        "bandwidth_hz": 71.6,
        "objective": -14.40,
        "first_resonance_hz": 110.5,
        "iterations": 25,
    },
    "improvement": {"hardware_cost_percent": -42.0, "bandwidth_percent": 28.0},
}

PUBLISHED: dict[str, dict[str, Any]] = {"two_mass": TWO_MASS, "rib_stage": RIB_STAGE}
