/* Compares the controller with the forces that the same integers gave in Python.
 *
 *     {{ compile }}
 *     ./controller_test        exit 0 where all forces are equal
 *     ./controller_test -      reads counts of errors from stdin, writes those of forces to stdout
 */
#include <stdio.h>

#include "controller.h"

#define SAMPLES {{ samples }}

static const controller_word errors[] = {{ integers(errors) }};
static const controller_word forwards[] = {{ integers(forwards) }};
static const controller_word first[] = {{ integers(first) }}; /* forces that were there before */
static const controller_word forces[] = {{ integers(forces) }};

static int stream(void)
{
    controller_state state;
    controller_word e[CONTROLLER_ERRORS], u[CONTROLLER_FORCES];
    long word;
    int i;

    controller_reset(&state);
    for (;;) {
        for (i = 0; i < CONTROLLER_ERRORS; i++) {
            if (scanf("%ld", &word) != 1)
                return 0;
            e[i] = (controller_word)word;
        }
        controller_step(&state, e, u);
        for (i = 0; i < CONTROLLER_FORCES; i++)
            printf("%ld%c", (long)u[i], i + 1 < CONTROLLER_FORCES ? ' ' : '\n');
    }
}

int main(int count, char **words)
{
    controller_state state;
    controller_word u[CONTROLLER_FORCES];
    int i, k, wrong = 0;

    if (count > 1 && words[1][0] == '-')
        return stream();
    controller_takeover(&state, errors, first);
    for (k = 0; k < SAMPLES; k++) {
        controller_step_forward(&state, &errors[k * CONTROLLER_ERRORS],
                                &forwards[k * CONTROLLER_FORCES], u);
        for (i = 0; i < CONTROLLER_FORCES; i++)
            wrong += u[i] != forces[k * CONTROLLER_FORCES + i];
    }
    printf("%d of %d forces differ\n", wrong, SAMPLES * CONTROLLER_FORCES);
    return wrong ? 1 : 0;
}
