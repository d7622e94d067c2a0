#include "controller.h"

/* The sizes of A's diagonal blocks, and the blocks row by row. */
static const int blocks[] = {{ '{' ~ blocks|join(', ') ~ '}' }};
static const {{ real }} A[] = {{ initialiser(A) }};
/* Row by row: states x errors, forces x states, forces x errors. */
static const {{ real }} B[] = {{ initialiser(B) }};
static const {{ real }} C[] = {{ initialiser(C) }};
static const {{ real }} D[] = {{ initialiser(D) }};
{% if L is not none %}
/* Back-calculation: states x forces. */
static const {{ real }} L[] = {{ initialiser(L) }};
{% endif %}
/* State of a start: states x (errors, then forces). */
static const {{ real }} X[] = {{ initialiser(X) }};
/* Feedforward: derivatives x forces x references. */
static const {{ real }} F[] = {{ initialiser(F) }};

void controller_reset(controller_state *state)
{
    int i;
    for (i = 0; i < CONTROLLER_STATES; i++)
        state->x[i] = 0.0;
}

void controller_takeover(controller_state *state, const {{ real }} e[CONTROLLER_ERRORS],
                         const {{ real }} u[CONTROLLER_FORCES])
{
    const {{ real }} *x = X;
    int i, j;

    for (i = 0; i < CONTROLLER_STATES; i++) {
        {{ real }} sum = 0.0;
        for (j = 0; j < CONTROLLER_ERRORS; j++)
            sum += *x++ * e[j];
        for (j = 0; j < CONTROLLER_FORCES; j++)
            sum += *x++ * u[j];
        state->x[i] = sum;
    }
}

void controller_forward(int axis, const {{ real }} r[5], {{ real }} f[CONTROLLER_FORCES])
{
    int i, k;

    for (i = 0; i < CONTROLLER_FORCES; i++) {
        f[i] = 0.0;
        for (k = 0; k < 5; k++)
            f[i] += F[(k * CONTROLLER_FORCES + i) * CONTROLLER_ERRORS + axis] * r[k];
    }
}

void controller_step(controller_state *state, const {{ real }} e[CONTROLLER_ERRORS],
                     {{ real }} u[CONTROLLER_FORCES])
{
    static const {{ real }} none[CONTROLLER_FORCES];

    controller_step_forward(state, e, none, u);
}

void controller_step_forward(controller_state *state, const {{ real }} e[CONTROLLER_ERRORS],
                             const {{ real }} f[CONTROLLER_FORCES], {{ real }} u[CONTROLLER_FORCES])
{
    {{ real }} next[{{ room }}];
{% if limit is not none %}
    {{ real }} cut[CONTROLLER_FORCES];
{% endif %}
    const {{ real }} *a = A;
    int i, j, block, start = 0;

    for (i = 0; i < CONTROLLER_FORCES; i++) {
        {{ real }} sum = 0.0;
        for (j = 0; j < CONTROLLER_STATES; j++)
            sum += C[i * CONTROLLER_STATES + j] * state->x[j];
        for (j = 0; j < CONTROLLER_ERRORS; j++)
            sum += D[i * CONTROLLER_ERRORS + j] * e[j];
        sum += f[i];
{% if limit is not none %}
        cut[i] = sum;
        if (sum > {{ limit }})
            sum = {{ limit }};
        if (sum < -{{ limit }})
            sum = -{{ limit }};
        cut[i] = sum - cut[i];
{% endif %}
        u[i] = sum;
    }
    for (block = 0; start < CONTROLLER_STATES; block++) {
        const int end = start + blocks[block];
        for (i = start; i < end; i++) {
            {{ real }} sum = 0.0;
            for (j = start; j < end; j++)
                sum += *a++ * state->x[j];
            for (j = 0; j < CONTROLLER_ERRORS; j++)
                sum += B[i * CONTROLLER_ERRORS + j] * e[j];
{% if L is not none %}
            for (j = 0; j < CONTROLLER_FORCES; j++)
                sum += L[i * CONTROLLER_FORCES + j] * cut[j];
{% endif %}
            next[i] = sum;
        }
        start = end;
    }
    for (i = 0; i < CONTROLLER_STATES; i++)
        state->x[i] = next[i];
}
