"""A controller as structured text of IEC 61131-3."""

import numpy as np

from ccd_casadi.deployment.realisation import Realisation, literal, literals
from ccd_casadi.deployment.source_code import ST_FILE, values_of
from ccd_casadi.extensions.formats import TEMPLATES
from ccd_casadi.support.text import template


def structured_text(
    realisation: Realisation, *, title: str, delay: float, verified: bool, kind: str = "Controller",
    no_limit: float = 1e30,
) -> str:  # fmt: skip
    """The function block; delay in s. A controller without states keeps one that stays at rest.

    Its words are such that matiec compiles them: no name of a standard function (LIMIT), no single
    letter that qualifies an action (D, L), and no FOR, which it skips where both ends are equal.
    """
    K, limit, sizes = realisation.system, realisation.saturation, realisation.blocks or (1,)
    n, (m, p), rest = sum(sizes), K.D.shape, {}
    if not len(K.A):
        shapes = {"A": (1, 1), "B": (1, p), "C": (m, 1), "X": (1, p + m), "L": (1, m)}
        rest = {name: np.zeros(shape) for name, shape in shapes.items()}
    starts = np.repeat(np.cumsum([0, *sizes[:-1]]), sizes)
    L = realisation.back_calculation
    values = values_of(realisation, title, delay, verified, kind) | {
        "n": n, "limit": literal(no_limit if limit is None else limit), "starts": starts,
        "ends": starts + np.repeat(sizes, sizes) - 1, "A": K.A,
        "L": np.zeros((n, m)) if L is None else L, "numbers": lambda entries: literals(entries, 8),
    }  # fmt: skip
    return template(f"{TEMPLATES}/{ST_FILE}").render(values | rest)
