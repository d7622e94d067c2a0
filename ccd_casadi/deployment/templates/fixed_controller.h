/* {{ kind }} of {{ title }} in integers of {{ bits }} bits, made by ccd-casadi.
 *
 * Call controller_step once every {{ period }} s ({{ rate }} Hz). It was {{ "verified" if verified else "NOT verified" }} with
 * {{ delay }} s from reading y to the new u at the actuator, and a zero-order hold, with the
 * coefficients of these integers.
 *   e[i]: r[i] - y[i] in counts of {{ error_steps|join(', ') }} m
 *   u[i], f[i]: in counts of {{ force_steps|join(', ') }} N
 * Words, states and forces saturate and never wrap; e has to be cut to a word before the call.
 * A state has {{ guard }} bits behind the point of its word. Right shifts of negative integers are
 * arithmetic, as every common compiler makes them; controller_test notices where they are not.
 */
#ifndef CONTROLLER_H
#define CONTROLLER_H

#include <stdint.h>

#define CONTROLLER_ERRORS {{ p }}
#define CONTROLLER_FORCES {{ m }}
#define CONTROLLER_STATES {{ n }}
#define CONTROLLER_PERIOD {{ period }}

typedef int{{ bits }}_t controller_word;

typedef struct {
    int{{ wide }}_t x[{{ [n, 1]|max }}];
} controller_state;

/* Put the controller to rest. */
void controller_reset(controller_state *state);

/* Take over without a jump: the next step with errors e gives the forces u. */
void controller_takeover(controller_state *state, const controller_word e[CONTROLLER_ERRORS],
                         const controller_word u[CONTROLLER_FORCES]);

/* One sample: the forces for these errors; the state is advanced. */
void controller_step(controller_state *state, const controller_word e[CONTROLLER_ERRORS],
                     controller_word u[CONTROLLER_FORCES]);

/* The same with feedforward f added before the limit. */
void controller_step_forward(controller_state *state, const controller_word e[CONTROLLER_ERRORS],
                             const controller_word f[CONTROLLER_FORCES],
                             controller_word u[CONTROLLER_FORCES]);

#endif
