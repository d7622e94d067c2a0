"""The difference equation as C99: a header, a source, and a test with its own vectors.

No allocation, no library but the test's, double precision. Data are row-major: the blocks of A one
after the other, then B (states × errors), C (forces × states), D (forces × errors). The output is
computed before the state is advanced, so that u leaves as early as it can.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

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
 *     u[k] = C x[k] + D e[k],   x[k+1] = A x[k] + B e[k]
 *
 * Call controller_step once every {period:.17g} s ({rate:.10g} Hz). It was {verified} with
 * {delay:.10g} s from reading y to the new u at the actuator, and a zero-order hold.
 *   e: e[i] = r[i] - y[i] in m, i = 0 .. CONTROLLER_ERRORS - 1
 *   u: u[i] in N, i = 0 .. CONTROLLER_FORCES - 1{saturation}
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

/* One sample: the forces for these errors; the state is advanced. */
void controller_step(controller_state *state, const double e[CONTROLLER_ERRORS],
                     double u[CONTROLLER_FORCES]);

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

void controller_reset(controller_state *state)
{{
    int i;
    for (i = 0; i < CONTROLLER_STATES; i++)
        state->x[i] = 0.0;
}}

void controller_step(controller_state *state, const double e[CONTROLLER_ERRORS],
                     double u[CONTROLLER_FORCES])
{{
    double next[{room}];
    const double *a = A;
    int i, j, block, start = 0;

    for (i = 0; i < CONTROLLER_FORCES; i++) {{
        double sum = 0.0;
        for (j = 0; j < CONTROLLER_STATES; j++)
            sum += C[i * CONTROLLER_STATES + j] * state->x[j];
        for (j = 0; j < CONTROLLER_ERRORS; j++)
            sum += D[i * CONTROLLER_ERRORS + j] * e[j];
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
            next[i] = sum;
        }}
        start = end;
    }}
    for (i = 0; i < CONTROLLER_STATES; i++)
        state->x[i] = next[i];
}}
"""

_CLIP = """\
        if (sum > {limit})
            sum = {limit};
        if (sum < -{limit})
            sum = -{limit};
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
    controller_reset(&state);
    for (k = 0; k < SAMPLES; k++) {{
        controller_step(&state, &errors[k * CONTROLLER_ERRORS], u);
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
    folder: Path, realisation: Realisation, *, title: str, delay: float, verified: bool
) -> None:
    """controller.h, controller.c and controller_test.c in `folder`; delay in s."""
    files = c_files(realisation, title=title, delay=delay, verified=verified)
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")


def c_files(
    realisation: Realisation, *, title: str, delay: float, verified: bool
) -> Mapping[str, str]:
    """The three files' texts by name; the header says whether the loop was verified."""
    K, limit = realisation.system, realisation.saturation
    n, p, m = len(K.A), K.B.shape[1], len(K.C)
    errors = ERROR * np.random.default_rng(0).standard_normal((SAMPLES, p))
    forces = difference_equation(realisation, errors)
    words = "" if limit is None else f", clipped to +-{limit:.17g} N; no anti-windup"
    plain = "".join(c if c.isalnum() or c in " ._-" else "_" for c in title)
    header = _HEADER.format(
        title=plain, period=K.period, rate=1.0 / K.period, delay=delay, saturation=words,
        n=n, p=p, m=m, room=max(n, 1), verified="verified" if verified else "NOT verified",
    )  # fmt: skip
    source = _SOURCE.format(
        blocks="{" + ", ".join(str(size) for size in realisation.blocks or (0,)) + "}",
        A=_numbers(realisation.block_entries), B=_numbers(K.B), C=_numbers(K.C),
        D=_numbers(K.D), room=max(n, 1),
        clip="" if limit is None else _CLIP.format(limit=f"{limit:.17g}"),
    )  # fmt: skip
    test = _TEST.format(
        compile=COMPILE, tolerance=TOLERANCE, samples=SAMPLES,
        errors=_numbers(errors), forces=_numbers(forces),
    )  # fmt: skip
    return dict(zip(FILES, (header, source, test), strict=True))


def _numbers(values: Array) -> str:
    """An initialiser; 17 digits give every double back exactly."""
    texts = [f"{value:.17g}" for value in np.ravel(values)] or ["0.0"]
    texts = [text if any(c in text for c in ".en") else f"{text}.0" for text in texts]
    lines = [", ".join(texts[i : i + 4]) for i in range(0, len(texts), 4)]
    return "{\n    " + ",\n    ".join(lines) + "\n}"
