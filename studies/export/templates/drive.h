/* Drives of a planar {{ machine }} robot: {{ text }}.
 *
{% for line in origin %}
 * {{ line }}
{% endfor %}
 *
 * Once per sample, at {{ NAME }}_RATE:
 *   1. put on the motors the feed-forward plus the feedback of the last call, limited to
 *      +-{{ NAME }}_LIMIT, and measure the actuated joints;
 *   2. call {{ name }}_step; its feedback goes out at the next sample.
 * That one sample of delay is part of the design. Begin with {{ name }}_init, feedback zero.
 */
#ifndef {{ NAME }}_H
#define {{ NAME }}_H

#ifdef __cplusplus
extern "C" {
#endif

/* double, or float with -D{{ NAME }}_REAL=float. */
#ifndef {{ NAME }}_REAL
#define {{ NAME }}_REAL double
#endif
typedef {{ NAME }}_REAL {{ name }}_real;

#define {{ NAME }}_RATE {{ rate }} /* Hz */

extern const {{ name }}_real {{ NAME }}_LIMIT[{{ n_links }}]; /* N, of each motor, +- */

typedef struct {
    {{ name }}_real force[{{ n_links }}];  /* N, feedback that acts during this sample */
    {{ name }}_real memory[{{ n_links }}]; /* of the law */
} {{ name }}_state;

/* At rest. */
void {{ name }}_init({{ name }}_state *state);

/* One sample: reference less measured position [m] and speed [m/s] of each slider, and the
 * feed-forward that acts during this sample [N]; returns the feedback of the next one [N]. A
 * motor with an argument that is not finite gets no feedback, and its law begins anew. */
void {{ name }}_step({{ name }}_state *state, const {{ name }}_real error[{{ n_links }}],
                     const {{ name }}_real error_rate[{{ n_links }}], const {{ name }}_real feedforward[{{ n_links }}],
                     {{ name }}_real feedback[{{ n_links }}]);

#ifdef __cplusplus
}
#endif

#endif
