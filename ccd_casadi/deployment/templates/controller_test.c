/* Compares the controller with the forces that the Python difference equation gave.
 *
 *     {{ compile }}
 *     ./controller_test        exit 0 where all forces agree to {{ tolerance }} of the largest
 *     ./controller_test -      reads errors from stdin, writes forces to stdout, a line a sample
 */
#include <stdio.h>

#include "controller.h"

#define SAMPLES {{ samples }}

static const {{ real }} errors[] = {{ initialiser(errors) }};
static const {{ real }} forwards[] = {{ initialiser(forwards) }};
static const {{ real }} first[] = {{ initialiser(first) }}; /* forces that were there before */
static const {{ real }} forces[] = {{ initialiser(forces) }};

static {{ real }} size({{ real }} value)
{
    return value < 0.0 ? -value : value;
}

static int stream(void)
{
    controller_state state;
    {{ real }} e[CONTROLLER_ERRORS], u[CONTROLLER_FORCES];
    double word;
    int i;

    controller_reset(&state);
    for (;;) {
        for (i = 0; i < CONTROLLER_ERRORS; i++) {
            if (scanf("%lf", &word) != 1)
                return 0;
            e[i] = ({{ real }})word;
        }
        controller_step(&state, e, u);
        for (i = 0; i < CONTROLLER_FORCES; i++)
            printf("%.17g%c", u[i], i + 1 < CONTROLLER_FORCES ? ' ' : '\n');
    }
}

int main(int count, char **words)
{
    controller_state state;
    {{ real }} u[CONTROLLER_FORCES], largest = 0.0, worst = 0.0;
    int i, k;

    if (count > 1 && words[1][0] == '-')
        return stream();
    controller_takeover(&state, errors, first);
    for (k = 0; k < SAMPLES; k++) {
        controller_step_forward(&state, &errors[k * CONTROLLER_ERRORS],
                                &forwards[k * CONTROLLER_FORCES], u);
        for (i = 0; i < CONTROLLER_FORCES; i++) {
            const {{ real }} wanted = forces[k * CONTROLLER_FORCES + i];
            if (size(wanted) > largest)
                largest = size(wanted);
            if (!(size(u[i] - wanted) <= worst))
                worst = size(u[i] - wanted);
        }
    }
    printf("largest force %g N, largest difference %g N\n", largest, worst);
    return worst <= {{ tolerance }} * largest ? 0 : 1;
}
