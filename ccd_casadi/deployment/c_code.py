"""The difference equation as C99: a header, a source, and a test with its own vectors.

No allocation, no library but the test's, double precision. Data are row-major: the blocks of A one
after the other, then B (states × errors), C (forces × states), D (forces × errors). The output is
computed before the state is advanced, so that u leaves as early as it can.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ccd_casadi.deployment.anti_windup import takeover
from ccd_casadi.deployment.feedforward import ORDER
from ccd_casadi.deployment.realisation import Realisation, difference_equation
from ccd_casadi.support.arrays import Array

COMPILE = (
    "cc -std=c99 -O2 -ffp-contract=off -Wall -Wextra -pedantic "
    "-o controller_test controller.c controller_test.c"
)
FILES = ("controller.h", "controller.c", "controller_test.c")
SAMPLES = 64  # of the test vectors
ERROR = 1e-6  # m; size of the errors in the test vectors
TOLERANCE = 1e-12  # of the largest force

_HEADER = """\
/* H-infinity controller of {title}, made by ccd-casadi.
 *
 *     v[k] = C x[k] + D e[k] + f[k],   u[k] = {limits}
 *     x[k+1] = A x[k] + B e[k]{back}
 *
 * Call controller_step once every {period:.17g} s ({rate:.10g} Hz). It was {verified} with
 * {delay:.10g} s from reading y to the new u at the actuator, and a zero-order hold.
 *   e: e[i] = r[i] - y[i] in m, i = 0 .. CONTROLLER_ERRORS - 1
 *   u: u[i] in N, i = 0 .. CONTROLLER_FORCES - 1
 * Compile with -ffp-contract=off where results have to be the same on every machine.
 */
#ifndef CONTROLLER_H
#define CONTROLLER_H

#define CONTROLLER_ERRORS {p}
#define CONTROLLER_FORCES {m}
#define CONTROLLER_STATES {n}
#define CONTROLLER_PERIOD {period:.17g}

typedef struct {{
    double x[{room}];
}} controller_state;

/* Put the controller to rest. */
void controller_reset(controller_state *state);

/* Take over without a jump: the next step with errors e gives the forces u. */
void controller_takeover(controller_state *state, const double e[CONTROLLER_ERRORS],
                         const double u[CONTROLLER_FORCES]);

/* One sample: the forces for these errors; the state is advanced. */
void controller_step(controller_state *state, const double e[CONTROLLER_ERRORS],
                     double u[CONTROLLER_FORCES]);

/* The same with feedforward f in N added before the limit. */
void controller_step_forward(controller_state *state, const double e[CONTROLLER_ERRORS],
                             const double f[CONTROLLER_FORCES], double u[CONTROLLER_FORCES]);

/* Feedforward of one reference: its position and four derivatives r[0] .. r[4], axis from 0.
 * The forces are those that the plant needs {ahead:.6g} s later, when they act. */
void controller_forward(int axis, const double r[5], double f[CONTROLLER_FORCES]);

#endif
"""

_SOURCE = """\
#include "controller.h"

/* The sizes of A's diagonal blocks, and the blocks row by row. */
static const int blocks[] = {blocks};
static const double A[] = {A};
/* Row by row: states x errors, forces x states, forces x errors. */
static const double B[] = {B};
static const double C[] = {C};
static const double D[] = {D};
{L}/* State of a start: states x (errors, then forces). */
static const double X[] = {X};
/* Feedforward: derivatives x forces x references. */
static const double F[] = {F};

void controller_reset(controller_state *state)
{{
    int i;
    for (i = 0; i < CONTROLLER_STATES; i++)
        state->x[i] = 0.0;
}}

void controller_takeover(controller_state *state, const double e[CONTROLLER_ERRORS],
                         const double u[CONTROLLER_FORCES])
{{
    const double *x = X;
    int i, j;

    for (i = 0; i < CONTROLLER_STATES; i++) {{
        double sum = 0.0;
        for (j = 0; j < CONTROLLER_ERRORS; j++)
            sum += *x++ * e[j];
        for (j = 0; j < CONTROLLER_FORCES; j++)
            sum += *x++ * u[j];
        state->x[i] = sum;
    }}
}}

void controller_forward(int axis, const double r[5], double f[CONTROLLER_FORCES])
{{
    int i, k;

    for (i = 0; i < CONTROLLER_FORCES; i++) {{
        f[i] = 0.0;
        for (k = 0; k < 5; k++)
            f[i] += F[(k * CONTROLLER_FORCES + i) * CONTROLLER_ERRORS + axis] * r[k];
    }}
}}

void controller_step(controller_state *state, const double e[CONTROLLER_ERRORS],
                     double u[CONTROLLER_FORCES])
{{
    static const double none[CONTROLLER_FORCES];

    controller_step_forward(state, e, none, u);
}}

void controller_step_forward(controller_state *state, const double e[CONTROLLER_ERRORS],
                             const double f[CONTROLLER_FORCES], double u[CONTROLLER_FORCES])
{{
    double next[{room}];
{cut_declared}    const double *a = A;
    int i, j, block, start = 0;

    for (i = 0; i < CONTROLLER_FORCES; i++) {{
        double sum = 0.0;
        for (j = 0; j < CONTROLLER_STATES; j++)
            sum += C[i * CONTROLLER_STATES + j] * state->x[j];
        for (j = 0; j < CONTROLLER_ERRORS; j++)
            sum += D[i * CONTROLLER_ERRORS + j] * e[j];
        sum += f[i];
{clip}        u[i] = sum;
    }}
    for (block = 0; start < CONTROLLER_STATES; block++) {{
        const int end = start + blocks[block];
        for (i = start; i < end; i++) {{
            double sum = 0.0;
            for (j = start; j < end; j++)
                sum += *a++ * state->x[j];
            for (j = 0; j < CONTROLLER_ERRORS; j++)
                sum += B[i * CONTROLLER_ERRORS + j] * e[j];
{cut_used}            next[i] = sum;
        }}
        start = end;
    }}
    for (i = 0; i < CONTROLLER_STATES; i++)
        state->x[i] = next[i];
}}
"""

_CLIP = """\
        cut[i] = sum;
        if (sum > {limit})
            sum = {limit};
        if (sum < -{limit})
            sum = -{limit};
        cut[i] = sum - cut[i];
"""

_BACK = """\
/* Back-calculation: states x forces. */
static const double L[] = {L};
"""

_LEAD_BACK = """\
            for (j = 0; j < CONTROLLER_FORCES; j++)
                sum += L[i * CONTROLLER_FORCES + j] * cut[j];
"""

_TEST = """\
/* Compares the controller with the forces that the Python difference equation gave.
 *
 *     {compile}
 *     ./controller_test        exit 0 where all forces agree to {tolerance:g} of the largest
 *     ./controller_test -      reads errors from stdin, writes forces to stdout, a line a sample
 */
#include <stdio.h>

#include "controller.h"

#define SAMPLES {samples}

static const double errors[] = {errors};
static const double forwards[] = {forwards};
static const double first[] = {first}; /* forces that were there before */
static const double forces[] = {forces};

static double size(double value)
{{
    return value < 0.0 ? -value : value;
}}

static int stream(void)
{{
    controller_state state;
    double e[CONTROLLER_ERRORS], u[CONTROLLER_FORCES];
    int i;

    controller_reset(&state);
    for (;;) {{
        for (i = 0; i < CONTROLLER_ERRORS; i++)
            if (scanf("%lf", &e[i]) != 1)
                return 0;
        controller_step(&state, e, u);
        for (i = 0; i < CONTROLLER_FORCES; i++)
            printf("%.17g%c", u[i], i + 1 < CONTROLLER_FORCES ? ' ' : '\\n');
    }}
}}

int main(int count, char **words)
{{
    controller_state state;
    double u[CONTROLLER_FORCES], largest = 0.0, worst = 0.0;
    int i, k;

    if (count > 1 && words[1][0] == '-')
        return stream();
    controller_takeover(&state, errors, first);
    for (k = 0; k < SAMPLES; k++) {{
        controller_step_forward(&state, &errors[k * CONTROLLER_ERRORS],
                                &forwards[k * CONTROLLER_FORCES], u);
        for (i = 0; i < CONTROLLER_FORCES; i++) {{
            const double wanted = forces[k * CONTROLLER_FORCES + i];
            if (size(wanted) > largest)
                largest = size(wanted);
            if (!(size(u[i] - wanted) <= worst))
                worst = size(u[i] - wanted);
        }}
    }}
    printf("largest force %g N, largest difference %g N\\n", largest, worst);
    return worst <= {tolerance:g} * largest ? 0 : 1;
}}
"""


def write_c(
    folder: Path, realisation: Realisation, *, title: str, delay: float, verified: bool,
    forward: Array | None = None,
) -> Mapping[str, str]:  # fmt: skip
    """controller.h, controller.c and controller_test.c in `folder`, and their texts; delay in s."""
    files = c_files(
        realisation, title=title, delay=delay, verified=verified, forward=forward
    )  # fmt: skip
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    return files


def c_files(
    realisation: Realisation, *, title: str, delay: float, verified: bool,
    forward: Array | None = None,
) -> Mapping[str, str]:  # fmt: skip
    """The three files' texts by name; the header says whether the loop was verified.

    `forward` (5, m, p) are the gains of `feedforward`; zeros where there are none.
    """
    K, limit, L = realisation.system, realisation.saturation, realisation.back_calculation
    n, p, m = len(K.A), K.B.shape[1], len(K.C)
    errors, forwards, first, forces = vectors(realisation)
    plain = "".join(c if c.isalnum() or c in " ._-" else "_" for c in title)
    header = _HEADER.format(
        title=plain, period=K.period, rate=1.0 / K.period, delay=delay,
        limits="v[k]" if limit is None else f"v[k] within +-{limit:.17g} N",
        back="" if L is None else " + L (u[k] - v[k])",
        ahead=delay + 0.5 * K.period, verified="verified" if verified else "NOT verified",
        n=n, p=p, m=m, room=max(n, 1),
    )  # fmt: skip
    clip = "" if limit is None else _CLIP.format(limit=f"{limit:.17g}")
    source = _SOURCE.format(
        blocks="{" + ", ".join(str(size) for size in realisation.blocks or (0,)) + "}",
        A=_numbers(realisation.block_entries), B=_numbers(K.B), C=_numbers(K.C),
        D=_numbers(K.D), room=max(n, 1), clip=clip,
        L="" if L is None else _BACK.format(L=_numbers(L)),
        X=_numbers(takeover(K)),
        F=_numbers(np.zeros((ORDER + 1, m, p)) if forward is None else forward),
        cut_declared="    double cut[CONTROLLER_FORCES];\n" if clip else "",
        cut_used="" if L is None else _LEAD_BACK,
    )  # fmt: skip
    test = _TEST.format(
        compile=COMPILE, tolerance=TOLERANCE, samples=SAMPLES,
        errors=_numbers(errors), forwards=_numbers(forwards), first=_numbers(first),
        forces=_numbers(forces),
    )  # fmt: skip
    return dict(zip(FILES, (header, source, test), strict=True))


def vectors(realisation: Realisation) -> tuple[Array, Array, Array, Array]:
    """Errors (k, p), feedforward (k, m), forces before (m,), and the forces (k, m) that follow.

    Where there is a limit the feedforward reaches beyond it, so that every path is walked.
    """
    K, limit = realisation.system, realisation.saturation
    rng = np.random.default_rng(0)
    errors = ERROR * rng.standard_normal((SAMPLES, K.B.shape[1]))
    size = limit if limit is not None else ERROR * float(np.abs(K.D).max() + 1.0)
    forwards = size * rng.standard_normal((SAMPLES, len(K.C)))
    first = np.full(len(K.C), 0.5 * size)
    start = [
        sum((gain * value for gain, value in zip(row, [*errors[0], *first], strict=True)), 0.0)
        for row in takeover(K).tolist()
    ]
    return errors, forwards, first, difference_equation(realisation, errors, forwards, start)


def _numbers(values: Array) -> str:
    """An initialiser; 17 digits give every double back exactly."""
    texts = [f"{value:.17g}" for value in np.ravel(values)] or ["0.0"]
    texts = [text if any(c in text for c in ".en") else f"{text}.0" for text in texts]
    lines = [", ".join(texts[i : i + 4]) for i in range(0, len(texts), 4)]
    return "{\n    " + ",\n    ".join(lines) + "\n}"
