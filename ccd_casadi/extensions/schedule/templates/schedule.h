/* Controllers of parts of a range of {{ name }}, made by ccd-casadi. Each is {{ status }} on its part.
 *
 * Call schedule_step once every {{ period }} s ({{ rate }} Hz) with the measured {{ name }}; {{ delay }} s from
 * reading y to the new u at the actuator, and a zero-order hold.
 *   e: r - y in m; u: forces in N
 * {{ name }} may change by {{ allowed }} {{ unit }}/s, simulated; a Lyapunov function falls up to {{ bound }} {{ unit }}/s, where
 * {{ name }} turns back {{ wait }} s after a handover or later: see schedule.json.
 * Compile with -ffp-contract=off where results have to be the same on every machine.
 */
#ifndef SCHEDULE_H
#define SCHEDULE_H

#define SCHEDULE_PARTS {{ parts }}
#define SCHEDULE_ERRORS {{ p }}
#define SCHEDULE_FORCES {{ m }}
#define SCHEDULE_STATES {{ n }}

typedef struct {
    double x[SCHEDULE_STATES];
    int part;
} schedule_state;

/* At rest, in the part for this {{ name }}. */
void schedule_reset(schedule_state *state, double at);

void schedule_step(schedule_state *state, double at, const double e[SCHEDULE_ERRORS],
                   double u[SCHEDULE_FORCES]);

#endif
