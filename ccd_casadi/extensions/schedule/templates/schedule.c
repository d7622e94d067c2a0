#include "schedule.h"

/* Part by part, row by row. */
static const double low[] = {
    {{ low }}
};
static const double high[] = {
    {{ high }}
};
static const double A[] = {
    {{ A }}
};
static const double B[] = {
    {{ B }}
};
static const double C[] = {
    {{ C }}
};
static const double D[] = {
    {{ D }}
};
/* A part's state from that of another: parts before x parts after x states x states. */
static const double T[] = {
    {{ T }}
};

static int part_at(int now, double at)
{
    int i, best = 0;
    double deepest = 0.0;

    if (now >= 0 && low[now] <= at && at <= high[now])
        return now;
    for (i = 0; i < SCHEDULE_PARTS; i++) {
        const double below = at - low[i], above = high[i] - at;
        const double depth = below < above ? below : above;

        if (i == 0 || depth > deepest) {
            deepest = depth;
            best = i;
        }
    }
    return best;
}

void schedule_reset(schedule_state *state, double at)
{
    int i;

    for (i = 0; i < SCHEDULE_STATES; i++)
        state->x[i] = 0.0;
    state->part = part_at(-1, at);
}

void schedule_step(schedule_state *state, double at, const double e[SCHEDULE_ERRORS],
                   double u[SCHEDULE_FORCES])
{
    const int part = part_at(state->part, at), n = SCHEDULE_STATES;
    const double *a = A + part * n * n, *b = B + part * n * SCHEDULE_ERRORS;
    const double *c = C + part * SCHEDULE_FORCES * n;
    const double *d = D + part * SCHEDULE_FORCES * SCHEDULE_ERRORS;
    double next[SCHEDULE_STATES];
    int i, j;

    if (part != state->part) {
        const double *t = T + (state->part * SCHEDULE_PARTS + part) * n * n;

        for (i = 0; i < n; i++) {
            double sum = 0.0;
            for (j = 0; j < n; j++)
                sum += *t++ * state->x[j];
            next[i] = sum;
        }
        for (i = 0; i < n; i++)
            state->x[i] = next[i];
        state->part = part;
    }
    for (i = 0; i < SCHEDULE_FORCES; i++) {
        double sum = 0.0;
        for (j = 0; j < n; j++)
            sum += *c++ * state->x[j];
        for (j = 0; j < SCHEDULE_ERRORS; j++)
            sum += *d++ * e[j];
        u[i] = sum;
    }
    for (i = 0; i < n; i++) {
        double sum = 0.0;
        for (j = 0; j < n; j++)
            sum += *a++ * state->x[j];
        for (j = 0; j < SCHEDULE_ERRORS; j++)
            sum += *b++ * e[j];
        next[i] = sum;
    }
    for (i = 0; i < n; i++)
        state->x[i] = next[i];
}
