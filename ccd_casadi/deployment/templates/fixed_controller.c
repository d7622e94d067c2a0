#include "controller.h"

#define GUARD {{ guard }}
#define LARGEST INT64_C({{ largest }})

/* A term is value * z[source] / 2^shift rounded down; z = [x; e; u - v], at the start [x; e; u]. */
typedef struct {
    controller_word value;
    int8_t shift;
    uint8_t source;
} term;

/* Sums of forces, of states, and of states at the start; where each begins. */
static const term terms[] = {
{% for row in rows %}{% for t in row %}
    {{ '{' ~ t.value ~ ', ' ~ t.shift ~ ', ' ~ t.source ~ '},' }}
{% endfor %}{% endfor %}
    {0, 0, 0}
};
static const uint16_t begins[] = {{ integers(ends) }};
static const int64_t limits[] = {{ integers(limits) }};

static int64_t sum(int row, const int64_t *z)
{
    int64_t total = 0;
    int k;

    for (k = begins[row]; k < begins[row + 1]; k++) {
        const int64_t product = terms[k].value * z[terms[k].source];
        if (terms[k].shift >= 0)
            total += product >> terms[k].shift;
        else
            total += product * (INT64_C(1) << -terms[k].shift);
    }
    return total;
}

static int64_t within(int64_t value, int64_t most)
{
    return value > most ? most : value < -most ? -most : value;
}

void controller_reset(controller_state *state)
{
    int i;
    for (i = 0; i < CONTROLLER_STATES; i++)
        state->x[i] = 0;
}

void controller_takeover(controller_state *state, const controller_word e[CONTROLLER_ERRORS],
                         const controller_word u[CONTROLLER_FORCES])
{
    int64_t z[CONTROLLER_STATES + CONTROLLER_ERRORS + CONTROLLER_FORCES] = {0};
    int i;

    for (i = 0; i < CONTROLLER_ERRORS; i++)
        z[CONTROLLER_STATES + i] = e[i];
    for (i = 0; i < CONTROLLER_FORCES; i++)
        z[CONTROLLER_STATES + CONTROLLER_ERRORS + i] = u[i];
    for (i = 0; i < CONTROLLER_STATES; i++)
        state->x[i] = within(sum(CONTROLLER_FORCES + CONTROLLER_STATES + i, z),
                             LARGEST * (INT64_C(1) << GUARD));
}

void controller_step(controller_state *state, const controller_word e[CONTROLLER_ERRORS],
                     controller_word u[CONTROLLER_FORCES])
{
    static const controller_word none[CONTROLLER_FORCES];

    controller_step_forward(state, e, none, u);
}

void controller_step_forward(controller_state *state, const controller_word e[CONTROLLER_ERRORS],
                             const controller_word f[CONTROLLER_FORCES],
                             controller_word u[CONTROLLER_FORCES])
{
    int64_t z[CONTROLLER_STATES + CONTROLLER_ERRORS + CONTROLLER_FORCES] = {0};
    int i;

    for (i = 0; i < CONTROLLER_STATES; i++)
        z[i] = (int64_t)state->x[i] >> GUARD;
    for (i = 0; i < CONTROLLER_ERRORS; i++)
        z[CONTROLLER_STATES + i] = e[i];
    for (i = 0; i < CONTROLLER_FORCES; i++) {
        const int64_t half = (INT64_C(1) << GUARD) >> 1;
        const int64_t v = (sum(i, z) + f[i] * (INT64_C(1) << GUARD) + half) >> GUARD;
        const int64_t cut = within(v, limits[i]);
        u[i] = (controller_word)cut;
        z[CONTROLLER_STATES + CONTROLLER_ERRORS + i] = within(cut - v, LARGEST);
    }
    for (i = 0; i < CONTROLLER_STATES; i++)
        state->x[i] = within(state->x[i] + sum(CONTROLLER_FORCES + i, z),
                             LARGEST * (INT64_C(1) << GUARD));
}
