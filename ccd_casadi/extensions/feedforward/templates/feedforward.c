#include "feedforward.h"

static const double h[] = {
    {{ h }}
};
/* Taps x derivatives x forces. */
static const double F[] = {
    {{ F }}
};

void feedforward_reset(feedforward_state *state)
{
    int i, j;

    for (i = 0; i < FEEDFORWARD_KEPT; i++)
        for (j = 0; j < 5; j++)
            state->r[i][j] = 0.0;
    state->now = 0;
}

void feedforward_step(feedforward_state *state, const double r[5], double *shaped,
                      double f[FEEDFORWARD_FORCES])
{
    int i, j, k;

    for (j = 0; j < 5; j++)
        state->r[state->now][j] = r[j];
    *shaped = 0.0;
    for (k = 0; k < FEEDFORWARD_FORCES; k++)
        f[k] = 0.0;
    for (i = 0; i < FEEDFORWARD_TAPS; i++) {
        const int at = state->now - i * FEEDFORWARD_SPACING;
        const double *then = state->r[at < 0 ? at + FEEDFORWARD_KEPT : at];

        *shaped += h[i] * then[0];
        for (j = 0; j < 5; j++)
            for (k = 0; k < FEEDFORWARD_FORCES; k++)
                f[k] += F[(i * 5 + j) * FEEDFORWARD_FORCES + k] * then[j];
    }
    state->now = (state->now + 1) % FEEDFORWARD_KEPT;
}
