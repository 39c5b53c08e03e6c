{% import "export/templates/shared.c" as shared with context %}
/* Drive of the actuated joints, see {{ name }}.h.
 *
{% for line in origin %}
 * {{ line }}
{% endfor %}
 */
#include "{{ name }}.h"

#include <math.h>

{{ shared.needs_nan() }}

typedef {{ name }}_real real;
#define R(x) ((real)(x))

/* [N] of each motor, +-; drive.force_limit */
const real {{ NAME }}_LIMIT{{ limit }};

/* Of each slider, in SI units; [drive], and own_ fields of [drive.kinds] */
{% for constant, values in constants %}
static const real {{ constant }}{{ values }};
{% endfor %}

static int is_finite(real x)
{
    return x - x <= 0;
}

void {{ name }}_init({{ name }}_state *s)
{
    int i;

    for (i = 0; i < {{ n_links }}; i++) {
        s->force[i] = R(0.0);
        s->memory[i] = R(0.0);
    }
}

void {{ name }}_step({{ name }}_state *s, const real error[{{ n_links }}], const real error_rate[{{ n_links }}],
                     const real feedforward[{{ n_links }}], real feedback[{{ n_links }}])
{
    int i;

    for (i = 0; i < {{ n_links }}; i++) {
        const real demand = feedforward[i] + s->force[i];
        const real above = demand > {{ NAME }}_LIMIT[i] ? {{ NAME }}_LIMIT[i] : demand;
        const real motor = above < -{{ NAME }}_LIMIT[i] ? -{{ NAME }}_LIMIT[i] : above;
        const real applied = motor - feedforward[i];
{% for line in force %}
        {{ line }}
{% endfor %}
{% for line in memory %}
        {{ line }}
{% endfor %}
        const int is_good = is_finite(error[i]) && is_finite(error_rate[i]) && is_finite(feedforward[i])
            && is_finite(force){{ " && is_finite(memory)" if memory }};

        (void)applied;
{% if memory %}
        s->memory[i] = is_good ? memory : R(0.0); /* or it would stay there */
{% endif %}
        s->force[i] = is_good ? force : R(0.0);
        feedback[i] = s->force[i];
    }
    (void)kp;
    (void)kd;
    (void)force_limit;
}
