/* {{ kind }} of {{ title }}, made by ccd-casadi.
 *
 *     v[k] = C x[k] + D e[k] + f[k],   u[k] = v[k]{{ '' if limit is none else ' within +-' ~ limit ~ ' N' }}
 *     x[k+1] = A x[k] + B e[k]{{ '' if L is none else ' + L (u[k] - v[k])' }}
 *
 * Call controller_step once every {{ period }} s ({{ rate }} Hz). It was {{ "verified" if verified else "NOT verified" }} with
 * {{ delay }} s from reading y to the new u at the actuator, and a zero-order hold.
 *   e: e[i] = r[i] - y[i] in m, i = 0 .. CONTROLLER_ERRORS - 1
 *   u: u[i] in N, i = 0 .. CONTROLLER_FORCES - 1
{% if real == "float" %}
 * Its coefficients were judged as they are rounded to float; y - r has to be formed in more digits.
{% endif %}
 * Compile with -ffp-contract=off where results have to be the same on every machine.
 */
#ifndef CONTROLLER_H
#define CONTROLLER_H

#define CONTROLLER_ERRORS {{ p }}
#define CONTROLLER_FORCES {{ m }}
#define CONTROLLER_STATES {{ n }}
#define CONTROLLER_PERIOD {{ period }}

typedef struct {
    {{ real }} x[{{ room }}];
} controller_state;

/* Put the controller to rest. */
void controller_reset(controller_state *state);

/* Take over without a jump: the next step with errors e gives the forces u. */
void controller_takeover(controller_state *state, const {{ real }} e[CONTROLLER_ERRORS],
                         const {{ real }} u[CONTROLLER_FORCES]);

/* One sample: the forces for these errors; the state is advanced. */
void controller_step(controller_state *state, const {{ real }} e[CONTROLLER_ERRORS],
                     {{ real }} u[CONTROLLER_FORCES]);

/* The same with feedforward f in N added before the limit. */
void controller_step_forward(controller_state *state, const {{ real }} e[CONTROLLER_ERRORS],
                             const {{ real }} f[CONTROLLER_FORCES], {{ real }} u[CONTROLLER_FORCES]);

/* Feedforward of one reference, axis from 0: r[0] is its position, r[1] .. r[4] are the means of its
 * four derivatives over a period about the instant, r[j] = (r^(j-1)(t + T/2) - r^(j-1)(t - T/2))/T.
 * The forces are those that the plant needs {{ ahead }} s later, when they act. */
void controller_forward(int axis, const {{ real }} r[5], {{ real }} f[CONTROLLER_FORCES]);

#endif
