"""The difference equation as IEC 61131-3 structured text: one function block for a PLC's fast task.

The same equation in the same order of operations as the C code (`c_code`), in LREAL. Only what
every PLC has is used: FOR, IF, arrays of constants. `RESET` puts it to rest, `TAKEOVER` begins with
the forces U_BEFORE, otherwise a call is one sample.
"""

import numpy as np

from ccd_casadi.deployment.anti_windup import takeover
from ccd_casadi.deployment.realisation import Realisation, literal, literals, plain_title
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.package_text import template

FILE = "controller.st"
TEMPLATE = f"deployment/templates/{FILE}"


def structured_text(realisation: Realisation, *, title: str, delay: float, verified: bool) -> str:
    """The function block; delay in s. A controller without states keeps one that stays at rest."""
    K = realisation.system
    m, p = K.D.shape
    A, B, C, X = K.A, K.B, K.C, takeover(K)
    sizes = realisation.blocks
    if not len(A):
        A, B, C, X = np.zeros((1, 1)), np.zeros((1, p)), np.zeros((m, 1)), np.zeros((1, p + m))
        sizes = (1,)
    n = len(A)
    L = realisation.back_calculation
    starts = np.repeat(np.concatenate([[0], np.cumsum(sizes)[:-1]]), sizes).astype(int)
    ends = starts + np.repeat(sizes, sizes) - 1
    limit = realisation.saturation
    return template(TEMPLATE, numbers=_numbers).render(
        title=plain_title(title), period=f"{K.period:.17g}", delay=f"{delay:.10g}",
        verified=verified, limit=literal(1e308 if limit is None else limit), n=n, m=m, p=p,
        starts=starts, ends=ends, A=A, B=B, C=C, D=K.D, X=X,
        L=np.zeros((n, m)) if L is None or not len(K.A) else L,
    )  # fmt: skip


def _numbers(values: Array) -> str:
    return literals(values, 8)
