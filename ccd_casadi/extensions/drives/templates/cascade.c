/* {{ title }}: position, velocity and filters of a drive,
   one call each period{% if slower > 1 %}; the position is read at every {{ slower }}th call{% endif %}.
   cc -std=c99 -O2 -ffp-contract=off; right shifts of negative integers are arithmetic. */
#include <math.h>
#include <stdint.h>
#include <string.h>

#define GRAIN {{ grain }}
#define PRODUCTS(part) ((c[0] part) * x + (c[1] part) * s[0] + (c[2] part) * s[1] \
    - (c[3] part) * s[2] - (c[4] part) * s[3])
typedef {{ real }} real;
typedef {{ number }} number;
typedef struct {
    real last, total, held, before, speed;
    int begun, call;
    number old[{{ [count, 1]|max }}][4];
} cascade_state;

static const number FILTERS[{{ [count, 1]|max }}][5] = {
{% for row in rows %}
    {{ "{" }}{{ row|join(", ") }}{{ "}" }}{{ "," if not loop.last }}
{% else %}
    {0}
{% endfor %}
};

static real filtered(const number *c, number *s, real u)
{
{% if number == "int64_t" %}
    /* of a whole product 64 bits hold no more than 8 kN: halves of the coefficients */
    number x = llrint(u / GRAIN);
    number y = (PRODUCTS(>> {{ half }}) + (PRODUCTS(& {{ 2 ** half - 1 }}) >> {{ half }})) >> {{ half }};
{% else %}
    number x = u;
    number y = c[0] * x + c[1] * s[0] + c[2] * s[1] - c[3] * s[2] - c[4] * s[3];
{% endif %}
    s[1] = s[0]; s[0] = x; s[3] = s[2]; s[2] = y;
    return {{ "(real)(y * GRAIN)" if number == "int64_t" else "y" }};
}

void cascade_reset(cascade_state *s) { memset(s, 0, sizeof *s); }

/* r, y: setpoint and sensor of the position, m: the motor's sensor, m; the force, N. */
real cascade_step(cascade_state *s, real r, real y, real m)
{
    real v, w, u, fast;
    int i;
    if (s->call == 0) s->held = {{ Kv }} * (r - y);
    s->call = (s->call + 1) % {{ slower }};
    if (!s->begun) { s->last = m; s->before = r; s->begun = 1; }
    fast = (r - s->before) * {{ rate }};
    s->before = r;
    v = s->held + {{ ahead }} * fast;
    for (i = 0; i < {{ setpoint }}; i++) v = filtered(FILTERS[i], s->old[i], v);
    w = v - (m - s->last) * {{ rate }};
    s->last = m;
    s->total = s->total + {{ share }} * w;
    u = {{ Kp }} * (w + s->total) + {{ push }} * (fast - s->speed);
    s->speed = fast;
    for (i = {{ setpoint }}; i < {{ count }}; i++) u = filtered(FILTERS[i], s->old[i], u);
    return u;
}
