"""The difference equation as IEC 61131-3 structured text: one function block for a PLC's fast task.

The same equation in the same order of operations as the C code (`c_code`), in LREAL. Only what
every PLC has is used: FOR, IF, arrays of constants. `RESET` puts it to rest, `TAKEOVER` begins with
the forces U_BEFORE, otherwise a call is one sample.
"""

import numpy as np

from ccd_casadi.deployment.anti_windup import takeover
from ccd_casadi.deployment.realisation import Realisation
from ccd_casadi.support.arrays import Array

FILE = "controller.st"

_TEXT = """\
(* H-infinity controller of {title}, made by ccd-casadi.
   Call once every {period:.17g} s; {verified} with {delay:.10g} s from reading y to the new U.
   E: r - y in m.  F: feedforward in N, added before the limit.  U: N. *)
FUNCTION_BLOCK FB_CONTROLLER
VAR_INPUT
    RESET : BOOL;
    TAKEOVER : BOOL;
    U_BEFORE : ARRAY[0..{m1}] OF LREAL;
    E : ARRAY[0..{p1}] OF LREAL;
    F : ARRAY[0..{m1}] OF LREAL;
END_VAR
VAR_OUTPUT
    U : ARRAY[0..{m1}] OF LREAL;
END_VAR
VAR
    X : ARRAY[0..{n1}] OF LREAL;
    NEXT : ARRAY[0..{n1}] OF LREAL;
    CUT : ARRAY[0..{m1}] OF LREAL;
    SUM : LREAL;
    I : DINT;
    J : DINT;
END_VAR
VAR CONSTANT
    LIMIT : LREAL := {limit};
    FIRST : ARRAY[0..{n1}] OF DINT := [{first}];
    LAST : ARRAY[0..{n1}] OF DINT := [{last}];
    A : ARRAY[0..{nn1}] OF LREAL := [{A}];
    B : ARRAY[0..{np1}] OF LREAL := [{B}];
    C : ARRAY[0..{mn1}] OF LREAL := [{C}];
    D : ARRAY[0..{mp1}] OF LREAL := [{D}];
    L : ARRAY[0..{nm1}] OF LREAL := [{L}];
    START : ARRAY[0..{nq1}] OF LREAL := [{X}];
END_VAR

IF RESET THEN
    FOR I := 0 TO {n1} DO
        X[I] := 0.0;
    END_FOR;
END_IF;
IF TAKEOVER THEN
    FOR I := 0 TO {n1} DO
        SUM := 0.0;
        FOR J := 0 TO {p1} DO
            SUM := SUM + START[I * {q} + J] * E[J];
        END_FOR;
        FOR J := 0 TO {m1} DO
            SUM := SUM + START[I * {q} + {p} + J] * U_BEFORE[J];
        END_FOR;
        X[I] := SUM;
    END_FOR;
END_IF;
FOR I := 0 TO {m1} DO
    SUM := 0.0;
    FOR J := 0 TO {n1} DO
        SUM := SUM + C[I * {n} + J] * X[J];
    END_FOR;
    FOR J := 0 TO {p1} DO
        SUM := SUM + D[I * {p} + J] * E[J];
    END_FOR;
    SUM := SUM + F[I];
    U[I] := SUM;
    IF SUM > LIMIT THEN
        U[I] := LIMIT;
    END_IF;
    IF SUM < -LIMIT THEN
        U[I] := -LIMIT;
    END_IF;
    CUT[I] := U[I] - SUM;
END_FOR;
FOR I := 0 TO {n1} DO
    SUM := 0.0;
    FOR J := FIRST[I] TO LAST[I] DO
        SUM := SUM + A[I * {n} + J] * X[J];
    END_FOR;
    FOR J := 0 TO {p1} DO
        SUM := SUM + B[I * {p} + J] * E[J];
    END_FOR;
    FOR J := 0 TO {m1} DO
        SUM := SUM + L[I * {m} + J] * CUT[J];
    END_FOR;
    NEXT[I] := SUM;
END_FOR;
FOR I := 0 TO {n1} DO
    X[I] := NEXT[I];
END_FOR;
END_FUNCTION_BLOCK
"""


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
    plain = "".join(c if c.isalnum() or c in " ._-" else "_" for c in title)
    limit, words = realisation.saturation, "verified" if verified else "NOT verified"
    return _TEXT.format(
        title=plain, period=K.period, delay=delay, verified=words,
        limit=_number(1e308 if limit is None else limit),
        n=n, m=m, p=p, q=p + m, n1=n - 1, m1=m - 1, p1=p - 1, nn1=n * n - 1, np1=n * p - 1,
        mn1=m * n - 1, mp1=m * p - 1, nm1=n * m - 1, nq1=n * (p + m) - 1,
        first=", ".join(map(str, starts)), last=", ".join(map(str, ends)),
        A=_numbers(A), B=_numbers(B), C=_numbers(C), D=_numbers(K.D), X=_numbers(X),
        L=_numbers(np.zeros((n, m)) if L is None or not len(K.A) else L),
    )  # fmt: skip


def _numbers(values: Array) -> str:
    texts = [_number(value) for value in np.ravel(values)]
    lines = [", ".join(texts[i : i + 4]) for i in range(0, len(texts), 4)]
    return ("," + "\n        ").join(lines)


def _number(value: float) -> str:
    """17 digits give every double back; IEC's literals want a point before the exponent."""
    text = f"{value:.17g}"
    mantissa, e, exponent = text.partition("e")
    return (mantissa if "." in mantissa else mantissa + ".0") + e + exponent
