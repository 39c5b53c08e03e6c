{% import "export/templates/shared.c" as shared with context %}
{% set force_unit = "N/m" if is_modal else "1" %}
{% set rate_unit = "1" if electronics.estimator == "modal_phase" else "1/s" %}
/* Controller and input shaper, see {{ name }}.h.
 *
{% for line in origin %}
 * {{ line }}
{% endfor %}
 *
 * Each constant: [unit], and the section or field of the study file it comes from.
 */
#include "{{ name }}.h"

{{ shared.needs_nan() }}

typedef {{ name }}_real real;
#define R(x) ((real)(x))

{{ shared.structure() }}

/* [V] one code at the ADC; adc_range, adc_bits */
static const real ADC_STEP = {{ real(controller.adc_step) }};

/* [V] highest code; adc_range */
static const real ADC_TOP = {{ real(controller.adc_top * controller.adc_step) }};

/* [V] at the ADC, sensor at rest; conditioner_bias */
static const real BIAS = {{ real(controller.adc_bias) }};

/* [1] ADC volt per sensor volt; electronics */
static const real CONDITIONER_GAIN = {{ real(controller.adc_gain) }};

/* [V] of every actuator, +-; voltage_limit */
static const real LIMIT = {{ real(controller.voltage_limit) }};

{% if blocks %}
/* [1] of the block's states, row by row; control.law */
static const real STATE{{ array(state_rows, blocks.names) }};

/* [1] of the system's sensors, per volt */
static const real ENTER{{ array(enter_rows, blocks.names) }};

/* [1] of the system's states, for each of its actuators */
static const real LEAVE{{ array(leave_rows, port_names) }};

/* [1] of the system's sensors, for each of its actuators */
static const real DIRECT{{ array(direct_rows, port_names) }};
{% if has_anti_windup %}

/* [1] of what the limits change on the system's actuators, per volt */
static const real ANTI_WINDUP{{ array(windup_rows, blocks.names) }};
{% endif %}
{% else %}
/* [{{ "m/V" if is_modal else "1" }}] modal filter pinv(lambda_s Phi_s^t): signal per volt of each
 * sensor of the link; control.basis, patches */
static const real FILTER{{ array(channels.filter, channels.names) }};

/* [{{ rate_unit }}; {{ rate_unit }}; 1] b0, b1, a1 of the velocity estimate's first section:
 * {{ shared.first_section() }} */
static const real HIGH_PASS{{ array(channels.first, channels.names) }};

/* [1] a1, a2 of its second section: {{ shared.second_section() }} */
static const real LOW_PASS{{ array(channels.denominator, channels.names) }};

/* [{{ force_unit }}] its numerator times the gains, -k_d n_v - k_p n_x;
 * control.gain_factor, velocity_gain, position_gain, ratios, gain_unit,
 * or damping, pole_decay, pole_frequency_hz */
static const real FORCE{{ array(channels.force, channels.names) }};

/* [{{ "V/N" if is_modal else "1" }}] voltage of each actuator of the link per force,
 * pinv(lambda_a Phi_a); control.basis, patches */
static const real SYNTHESIZER{{ array(channels.synthesizer, channels.names) }};
{% endif %}

{{ shared.taps("real", weight) }}
{% if has_rivals %}

{{ shared.rivals() }}

/* [1/s] modal velocity; energy */
static const real RATE{{ array(velocity, channels.names) }};

/* [1/s] omega times modal position */
static const real PLACE{{ array(position, channels.names) }};
{% endif %}
{% if not blocks and channels.has_direct %}

/* [{{ force_unit }}] force past the filters; control.position_gain */
static const real DIRECT{{ array(channels.direct) }};
{% endif %}
{% if has_feedthrough %}

/* [1] sensor volts per volt of each actuator of the link, through uncontrolled modes;
 * control.feedthrough_factor */
static const real FEEDTHROUGH{{ array(feedthrough, patches) }};
{% endif %}

/* Whether a sensor is faulty: its number from 1, else 0. A NaN fails every comparison. */
static int check({{ name }}_state *state, const real sensor[{{ NAME }}_N_CHANNELS])
{
    int16_t *at;
    int k;

    for (k = 0; k < {{ NAME }}_N_CHANNELS; k++) {
        if (!IS_USED[k / {{ NAME }}_N_PATCHES]) {
            continue;
        }
        if (!(sensor[k] >= -ADC_STEP && sensor[k] <= ADC_TOP + ADC_STEP)) {
            return k + 1;
        }
        at = &state->rail[k];
        if (sensor[k] < ADC_STEP / 2) {
            *at = (int16_t)(*at < 0 ? *at - 1 : -1);
        } else if (sensor[k] >= ADC_TOP - ADC_STEP / 2) {
            *at = (int16_t)(*at > 0 ? *at + 1 : 1);
        } else {
            *at = 0;
        }
        if (*at >= {{ NAME }}_RAIL_SAMPLES || *at <= -{{ NAME }}_RAIL_SAMPLES) {
            return k + 1;
        }
    }
    return 0;
}

/* Whether all coordinates are finite. */
static int is_pose(const real reference[{{ NAME }}_N_POSE])
{
    int axis;

    for (axis = 0; axis < {{ NAME }}_N_POSE; axis++) {
        if (!(reference[axis] - reference[axis] <= 0)) {
            return 0;
        }
    }
    return 1;
}

{{ shared.state("is_pose(reference) ? reference[axis] : 0") }}

static real within(real volts)
{
    return volts > LIMIT ? LIMIT : volts < -LIMIT ? -LIMIT : volts;
}

int {{ name }}_step({{ name }}_state *state, const real sensor[{{ NAME }}_N_CHANNELS],
    real actuator[{{ NAME }}_N_CHANNELS])
{
    real volt[{{ NAME }}_N_CHANNELS]; /* of the sensors [V] */
    real wanted[{{ NAME }}_N_CHANNELS]; /* of the actuators, without limit [V] */
    {% if has_rivals %}
    real forces[{{ NAME }}_N_MODES], energy[{{ NAME }}_N_MODES]; /* of the channels */
    {% endif %}
    int k, m{{ ", s" if blocks }}{{ ", first" if has_first }};

    if (!state->fault) {
        state->fault = check(state, sensor);
    }
    if (state->fault) {
        forget(state);
        for (k = 0; k < {{ NAME }}_N_CHANNELS; k++) {
            actuator[k] = 0;
        }
        return state->fault;
    }
    for (k = 0; k < {{ NAME }}_N_CHANNELS; k++) {
        volt[k] = IS_USED[k / {{ NAME }}_N_PATCHES] ? (sensor[k] - BIAS) / CONDITIONER_GAIN : 0;
        wanted[k] = 0;
    }
    {% if has_feedthrough %}
    for (k = 0; k < {{ NAME }}_N_CHANNELS; k++) {
        first = {{ NAME }}_N_PATCHES * (k / {{ NAME }}_N_PATCHES);
        for (m = 0; IS_USED[k / {{ NAME }}_N_PATCHES] && m < {{ NAME }}_N_PATCHES; m++) {
            volt[k] -= FEEDTHROUGH[k][m] * state->command[first + m];
        }
    }
    {% endif %}
    {% if blocks %}
    for (s = 0; s < N_SYSTEMS; s++) {
        const real *in = volt + FIRST[s];
        real *x = state->x + s * ORDER;
        {% if has_anti_windup %}
        real change[N_PORTS]; /* of the demands, by the limits [V] */
        {% endif %}

        for (k = 0; k < N_PORTS; k++) {
            real sum = 0;

            for (m = 0; m < ORDER; m++) {
                sum += LEAVE[s * N_PORTS + k][m] * x[m];
            }
            for (m = 0; m < N_PORTS; m++) {
                sum += DIRECT[s * N_PORTS + k][m] * in[m];
            }
            wanted[FIRST[s] + k] = sum;
            {% if has_anti_windup %}
            change[k] = within(sum) - sum;
            {% endif %}
        }
        for (m = 0; m < ORDER; m += BLOCK) {
            real next[BLOCK];

            for (k = 0; k < BLOCK; k++) {
                const int row = s * ORDER + m + k;
                int from, port;

                next[k] = 0;
                for (from = 0; from < BLOCK; from++) {
                    next[k] += STATE[row][from] * x[m + from];
                }
                for (port = 0; port < N_PORTS; port++) {
                    next[k] += ENTER[row][port] * in[port];
                    {% if has_anti_windup %}
                    next[k] += ANTI_WINDUP[row][port] * change[port];
                    {% endif %}
                }
            }
            for (k = 0; k < BLOCK; k++) {
                x[m + k] = next[k];
            }
        }
    }
    {% else %}
    for (m = 0; m < {{ NAME }}_N_MODES; m++) {
        real signal = 0, high, inner, force{% if has_rivals %}, rate, place{% endif %};
        real *line = state->line[m];

        first = {{ NAME }}_N_PATCHES * LINK[m];
        for (k = 0; k < {{ NAME }}_N_PATCHES; k++) {
            signal += FILTER[m][k] * volt[first + k];
        }
        high = HIGH_PASS[m][0] * signal + state->high[m];
        state->high[m] = HIGH_PASS[m][1] * signal - HIGH_PASS[m][2] * high;
        inner = high - LOW_PASS[m][0] * line[0] - LOW_PASS[m][1] * line[1];
        force = FORCE[m][0] * inner + FORCE[m][1] * line[0] + FORCE[m][2] * line[1]
            {%- if channels.has_direct +%}
            + DIRECT[m] * signal
            {%- endif %};
        {% if has_rivals %}
        rate = RATE[m][0] * inner + RATE[m][1] * line[0] + RATE[m][2] * line[1];
        place = PLACE[m][0] * inner + PLACE[m][1] * line[0] + PLACE[m][2] * line[1]
            + PLACE[m][3] * signal;
        energy[m] = rate * rate + place * place;
        forces[m] = force;
        {% endif %}
        line[1] = line[0];
        line[0] = inner;
        {% if not has_rivals %}
        for (k = 0; k < {{ NAME }}_N_PATCHES; k++) {
            wanted[first + k] += SYNTHESIZER[m][k] * force;
        }
        {% endif %}
    }
    {% if has_rivals %}
    for (m = 0; m < {{ NAME }}_N_MODES; m++) {
        int acts = 1;

        for (k = 0; k < {{ NAME }}_N_MODES; k++) {
            if (IS_RIVAL[m] && IS_RIVAL[k] && LINK[k] == LINK[m] && energy[k] > energy[m]) {
                acts = 0;
            }
        }
        first = {{ NAME }}_N_PATCHES * LINK[m];
        for (k = 0; acts && k < {{ NAME }}_N_PATCHES; k++) {
            wanted[first + k] += SYNTHESIZER[m][k] * forces[m];
        }
    }
    {% endif %}
    {% endif %}
    for (k = 0; k < {{ NAME }}_N_CHANNELS; k++) {
        actuator[k] = within(wanted[k]);
        {% if has_feedthrough %}
        state->command[k] = actuator[k];
        {% endif %}
    }
    return 0;
}

void {{ name }}_shape_step({{ name }}_shaper *shaper, const real reference[{{ NAME }}_N_POSE], real shaped[{{ NAME }}_N_POSE])
{
    real sum[{{ NAME }}_N_POSE] = {0};
    const int is_given = is_pose(reference);
    uint32_t at, last;
    int k, axis;

    {{ shared.advance() }}
    for (axis = 0; axis < {{ NAME }}_N_POSE; axis++) {
        shaper->past[shaper->newest][axis] = is_given ? reference[axis] : shaper->past[last][axis];
    }
    for (k = 0; k < N_TAPS; k++) {
        at = shaper->newest + DELAY[k];
        if (at >= {{ NAME }}_SHAPER_LENGTH) {
            at -= {{ NAME }}_SHAPER_LENGTH;
        }
        for (axis = 0; axis < {{ NAME }}_N_POSE; axis++) {
            sum[axis] += WEIGHT[k] * shaper->past[at][axis];
        }
    }
    for (axis = 0; axis < {{ NAME }}_N_POSE; axis++) {
        shaped[axis] = sum[axis];
    }
}
