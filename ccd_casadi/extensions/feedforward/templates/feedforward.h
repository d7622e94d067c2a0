/* Feedforward and shaper of a setpoint, made by ccd-casadi for every plant of a set.
 *
 *     shaped[k] = sum_i h[i] r[0][k - i d],   f[k] = sum_i sum_j F[i][j] r[j][k - i d]
 *
 * Call feedforward_step once every {{ period }} s, before the controller:
 *     e = shaped - y,   controller_step_forward(&state, e, f, u)
 *   r: the setpoint in m, and the means of its four derivatives over a period about the instant,
 *      r[j] = (r^(j-1)(t + T/2) - r^(j-1)(t - T/2))/T
 *   f: forces in N
 */
#ifndef FEEDFORWARD_H
#define FEEDFORWARD_H

#define FEEDFORWARD_FORCES {{ m }}
#define FEEDFORWARD_TAPS {{ taps }}
#define FEEDFORWARD_SPACING {{ spacing }}
#define FEEDFORWARD_KEPT {{ last + 1 }}

typedef struct {
    double r[FEEDFORWARD_KEPT][5]; /* the last setpoints, a ring */
    int now;
} feedforward_state;

/* At rest at the setpoint 0, where every move begins. */
void feedforward_reset(feedforward_state *state);

void feedforward_step(feedforward_state *state, const double r[5], double *shaped,
                      double f[FEEDFORWARD_FORCES]);

#endif
