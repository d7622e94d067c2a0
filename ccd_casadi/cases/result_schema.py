"""The JSON Schema of result.json: the keys that scripts rely on; what else is there is allowed.

Files of before `format` was written pass too. A figure that cannot be told is null.
"""

from typing import Any

FORMAT = 1  # of result.json: raised when a key goes or changes its meaning
DRAFT = "https://json-schema.org/draft/2020-12/schema"
NUMBER = ["number", "null"]
ALWAYS: dict[str, Any] = {
    "status": {"enum": ["verified", "not_verified", "infeasible"]},
    "reason": {"type": "string"},
    "formulation": {"enum": ["nested", "lifted", "direct"]},
    "syntheses": {"type": "integer", "minimum": 0},
    "spent": {"additionalProperties": {"type": "integer", "minimum": 0}},
    "seconds": {"type": "number"},
    "seed": {"type": "integer"},
    "versions": {"additionalProperties": {"type": "string"}},
}
CERTIFICATE = {"stable": "boolean", "passed": "boolean", "max_real_pole": NUMBER, "norm": NUMBER,
               "norm_bound": NUMBER}  # fmt: skip
LINE = {"properties": {"state": {"enum": ["passed", "warned", "failed", "unknown"]},
                       "words": {"type": "string"}}, "required": ["state", "words"]}  # fmt: skip
NAMES = ("certified", "optimal", "predicted", "survives", "deployable")
FIGURES = [
    "objective", "hardware_cost", "bandwidth_hz", "omega_S_hz", "omega_T_hz",
    "surrogate_bandwidth_hz", "verification_error", "gamma_opt", "gamma", "gamma_lower_bound",
    "sensitivity_peak", "sensitivity_peak_hz", "sensitivity_low", "inner_gap",
]  # fmt: skip
OF_A_DESIGN: dict[str, Any] = {
    "theta": {"minProperties": 1, "additionalProperties": {"type": "number"}},
    **{name: {"type": NUMBER} for name in FIGURES},
    "certificate": {
        "properties": {name: {"type": kind} for name, kind in CERTIFICATE.items()},
        "required": [*CERTIFICATE],
    },
    "checks": {"additionalProperties": {"type": "boolean"}},
    "verdict": {"properties": dict.fromkeys(NAMES, LINE), "required": [*NAMES]},
    "kkt": {"required": ["stationarity"]},
    "active": {"type": "array", "items": {"type": "string"}},
}


def result_schema() -> dict[str, Any]:
    """Keys and types; those of a design where one was found."""
    keys = {"format": {"const": FORMAT}} | ALWAYS | OF_A_DESIGN
    objects = {"spent", "versions", "theta", "certificate", "checks", "verdict", "kkt"}
    return {
        "$schema": DRAFT,
        "title": "result.json of ccd-casadi",
        "type": "object",
        "properties": {
            name: ({"type": "object"} if name in objects else {}) | check
            for name, check in keys.items()
        },
        "required": [name for name in ALWAYS if name != "spent"],
        "dependentRequired": {"format": ["spent"]},  # which came a little before
        "if": {"properties": {"status": {"const": "infeasible"}}},
        "else": {"required": [*OF_A_DESIGN]},
    }
