{% import "export/templates/shared.c" as shared with context %}
{% set wide = "int%d_t" % (2 * word_bits) %}
{% set pose = "" if word_bits == 32 else "pose_" %}
/* Controller and input shaper in fixed point, see {{ name }}.h.
 *
{% for line in origin %}
 * {{ line }}
{% endfor %}
 *
 * Every signal is a {{ word_bits }}-bit integer; its unit is in the table of formats. A sum of products is formed
 * in {{ 2 * word_bits }} bits, without overflow (the coefficients of a row add up to less than 2^{{ word_bits - 1 }}), then
 * shifted right with rounding and limited to {{ word_bits }} bits. So coefficient = integer / 2^shift, and its
 * unit is counts of the result per count of what it multiplies.
 *
 * Formats: value = base * integer / 2^Q. The base is the largest value in the simulated motion; a
 * word has room for `room` times that, and ADC codes can produce at most `reach` times that. A
 * coefficient from signal a to signal b, in SI units, is
 * integer / 2^shift * (base_b / 2^Q_b) / (base_a / 2^Q_a); one ADC code is {{ code | short(9) }} V
 * at a sensor, one DAC code {{ fixed.wires.dac_step | short(9) }} V at an actuator.
 *
{% for line in formats %}
 * {{ line }}
{% endfor %}
 *
 * Each constant: [unit], and the section or field of the study file it comes from.
 * {{ cost }}
 */
#include "{{ name }}.h"

{{ shared.structure() }}

{% if not blocks %}
/* first mode of each link, and the end; control */
static const uint16_t FIRST_MODE{{ array(first_mode) }};

{% endif %}
/* [code] highest one; adc_bits */
static const uint16_t ADC_TOP = {{ fixed.wires.adc_top }};

/* [count] of a sensor per code; adc_bits */
static const int32_t ADC_UNIT = {{ 2 ** fixed.wires.adc_bits }};

/* [count] sensor at rest; conditioner_bias */
static const {{ wide }} BIAS = {{ fixed.wires.bias }};

/* [code] of 0 V at an actuator; the DAC's bits */
static const int32_t DAC_REST = {{ fixed.wires.dac_rest }};

{% if blocks %}
/* [state/state] those of the block, then [state/sensor] of the system's sensors; control.law */
static const {{ count }} ADVANCE{{ array(advance, blocks.names) }};

/* [bit] of each row */
static const uint16_t ADVANCE_SHIFT{{ array(advance_shift) }};

/* [code/state] of the system's states, then [code/sensor] of its sensors, for each actuator */
static const {{ count }} LEAVE{{ array(leave, port_names) }};

/* [bit] of each row */
static const uint16_t LEAVE_SHIFT{{ array(leave_shift) }};
{% if has_anti_windup %}

/* [state/code] of what the limits change on the system's actuators */
static const {{ count }} ANTI_WINDUP{{ array(windup, blocks.names) }};

/* [bit] of each row */
static const uint16_t ANTI_WINDUP_SHIFT{{ array(windup_shift) }};
{% endif %}
{% else %}
/* [signal/sensor] modal filter pinv(lambda_s Phi_s^t); control.basis, patches */
static const {{ count }} FILTER{{ array(fixed.filter.integers, channels.names) }};

/* [bit] of each row */
static const uint16_t FILTER_SHIFT{{ array(fixed.filter.shift) }};

/* [high/signal; high/signal, 1] b0; b1, -a1 of the velocity estimate's first section:
 * {{ shared.first_section() }} */
static const {{ count }} HIGH_PASS{{ array(high_pass, channels.names) }};

/* [bit] of b0; of b1 and -a1 */
static const uint16_t HIGH_PASS_SHIFT{{ array(high_pass_shift) }};

/* [delay line/high, 1, 1] scale, -a1, -a2 of its second section:
 * {{ shared.second_section() }} */
static const {{ count }} LOW_PASS{{ array(fixed.low_pass.integers, channels.names) }};

/* [bit] of each row */
static const uint16_t LOW_PASS_SHIFT{{ array(fixed.low_pass.shift) }};

/* [force/delay line] its numerator times the gains, -k_d n_v - k_p n_x;
 * control.gain_factor, velocity_gain, position_gain, ratios, gain_unit,
 * or damping, pole_decay, pole_frequency_hz */
static const {{ count }} FORCE{{ array(force, channels.names) }};

/* [bit] of each row */
static const uint16_t FORCE_SHIFT{{ array(fixed.numerator.shift) }};

/* [code/force] of each actuator of the link, pinv(lambda_a Phi_a); control.basis, patches */
static const {{ count }} SYNTHESIZER{{ array(synthesizer, channels.names) }};

/* [bit] of each actuator */
static const uint16_t SYNTHESIZER_SHIFT{{ array(fixed.synthesizer.shift.ravel()) }};
{% endif %}

{{ shared.taps("int32_t", weight) }}

/* [bit] of all weights */
static const int WEIGHT_SHIFT = {{ weight_shift }};
{% if fixed.energy %}

{{ shared.rivals() }}

/* [energy root/delay line; energy root/signal] modal velocity, omega position */
static const {{ count }} ENERGY{{ array(energy, energy_names) }};

/* [bit] of each row */
static const uint16_t ENERGY_SHIFT{{ array(fixed.energy.shift.ravel()) }};
{% endif %}
{% if not blocks and channels.has_direct %}

/* [force/signal] force past the filters, shifted as FORCE; control.position_gain */
static const {{ count }} DIRECT{{ array(direct) }};
{% endif %}
{% if has_feedthrough %}

/* [sensor/code] of each actuator of the link, through uncontrolled modes;
 * control.feedthrough_factor */
static const {{ count }} FEEDTHROUGH{{ array(feedthrough, patches) }};

/* [bit] of each row */
static const uint16_t FEEDTHROUGH_SHIFT{{ array(fixed.wires.feedthrough.shift.ravel()) }};
{% endif %}

{% macro arithmetic(prefix, count, sum, bits) %}
static {{ count }} {{ prefix }}limited({{ sum }} x)
{
    return x > INT{{ bits }}_MAX ? INT{{ bits }}_MAX : x < INT{{ bits }}_MIN ? INT{{ bits }}_MIN : ({{ count }})x;
}

/* Round to nearest, halves up. Needs a right shift that keeps the sign; all compilers have it. */
static {{ sum }} {{ prefix }}shifted({{ sum }} sum, int shift)
{
    return (sum + (({{ sum }})1 << (shift - 1))) >> shift;
}
{% endmacro %}
{{ arithmetic("", count, wide, word_bits) }}
{% if word_bits != 32 %}
{{ arithmetic("pose_", "int32_t", "int64_t", 32) }}
{% endif %}
/* A command within the DAC's codes. */
static int32_t within({{ wide }} command)
{
    const {{ wide }} most = DAC_REST - 1;

    return (int32_t)(command > most ? most : command < -most ? -most : command);
}

/* Whether a sensor is faulty: its number from 1, else 0. */
static int check({{ name }}_state *state, const uint16_t sensor[{{ NAME }}_N_CHANNELS])
{
    int16_t *at;
    int k;

    for (k = 0; k < {{ NAME }}_N_CHANNELS; k++) {
        if (!IS_USED[k / {{ NAME }}_N_PATCHES]) {
            continue;
        }
        if (sensor[k] > ADC_TOP) {
            return k + 1;
        }
        at = &state->rail[k];
        if (sensor[k] == 0) {
            *at = (int16_t)(*at < 0 ? *at - 1 : -1);
        } else if (sensor[k] == ADC_TOP) {
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

{{ shared.state("reference[axis]") }}

int {{ name }}_step({{ name }}_state *state, const uint16_t sensor[{{ NAME }}_N_CHANNELS],
    uint16_t actuator[{{ NAME }}_N_CHANNELS])
{
    {{ count }} sensed[{{ NAME }}_N_CHANNELS]; /* sensor signals */
    {% if blocks %}
    {{ wide }} wanted[{{ NAME }}_N_CHANNELS]; /* codes, without limits */
    {% else %}
    {{ count }} force[{{ NAME }}_N_MODES]; /* channel forces */
    {% endif %}
    {% if fixed.energy %}
    {{ wide }} energy[{{ NAME }}_N_MODES]; /* of the channels */
    {% endif %}
    {{ wide }} sum;
    int k, m{{ ", s" if blocks }}{{ ", first" if has_first }};

    if (!state->fault) {
        state->fault = check(state, sensor);
    }
    if (state->fault) {
        forget(state);
        for (k = 0; k < {{ NAME }}_N_CHANNELS; k++) {
            actuator[k] = (uint16_t)DAC_REST;
        }
        return state->fault;
    }
    for (k = 0; k < {{ NAME }}_N_CHANNELS; k++) {
        if (IS_USED[k / {{ NAME }}_N_PATCHES]) {
            sensed[k] = limited(({{ wide }})sensor[k] * ADC_UNIT - BIAS);
        }
    }
    {% if has_feedthrough %}
    for (k = 0; k < {{ NAME }}_N_CHANNELS; k++) {
        first = {{ NAME }}_N_PATCHES * (k / {{ NAME }}_N_PATCHES);
        sum = 0;
        for (m = 0; IS_USED[k / {{ NAME }}_N_PATCHES] && m < {{ NAME }}_N_PATCHES; m++) {
            sum += ({{ wide }})FEEDTHROUGH[k][m] * state->command[first + m];
        }
        if (IS_USED[k / {{ NAME }}_N_PATCHES]) {
            sensed[k] = limited(sensed[k] - shifted(sum, FEEDTHROUGH_SHIFT[k]));
        }
    }
    {% endif %}
    {% if blocks %}
    for (k = 0; k < {{ NAME }}_N_CHANNELS; k++) {
        wanted[k] = 0;
        if (!IS_USED[k / {{ NAME }}_N_PATCHES]) {
            sensed[k] = 0;
        }
    }
    for (s = 0; s < N_SYSTEMS; s++) {
        const {{ count }} *in = sensed + FIRST[s];
        {{ count }} *x = state->x + s * ORDER;
        {% if has_anti_windup %}
        {{ count }} change[N_PORTS]; /* of the demands, by the limits [code] */
        {% endif %}

        for (k = 0; k < N_PORTS; k++) {
            const int row = s * N_PORTS + k;

            sum = 0;
            for (m = 0; m < ORDER; m++) {
                sum += ({{ wide }})LEAVE[row][m] * x[m];
            }
            for (m = 0; m < N_PORTS; m++) {
                sum += ({{ wide }})LEAVE[row][ORDER + m] * in[m];
            }
            wanted[FIRST[s] + k] = shifted(sum, LEAVE_SHIFT[row]);
            {% if has_anti_windup %}
            change[k] = limited(within(wanted[FIRST[s] + k]) - wanted[FIRST[s] + k]);
            {% endif %}
        }
        for (m = 0; m < ORDER; m += BLOCK) {
            {{ count }} next[BLOCK];

            for (k = 0; k < BLOCK; k++) {
                const int row = s * ORDER + m + k;
                int from, port;

                sum = 0;
                for (from = 0; from < BLOCK; from++) {
                    sum += ({{ wide }})ADVANCE[row][from] * x[m + from];
                }
                for (port = 0; port < N_PORTS; port++) {
                    sum += ({{ wide }})ADVANCE[row][BLOCK + port] * in[port];
                }
                {% if has_anti_windup %}
                sum = shifted(sum, ADVANCE_SHIFT[row]);
                {
                    {{ wide }} told = 0;

                    for (port = 0; port < N_PORTS; port++) {
                        told += ({{ wide }})ANTI_WINDUP[row][port] * change[port];
                    }
                    next[k] = limited(sum + shifted(told, ANTI_WINDUP_SHIFT[row]));
                }
                {% else %}
                next[k] = limited(shifted(sum, ADVANCE_SHIFT[row]));
                {% endif %}
            }
            for (k = 0; k < BLOCK; k++) {
                x[m + k] = next[k];
            }
        }
    }
    {% else %}
    for (m = 0; m < {{ NAME }}_N_MODES; m++) {
        {{ count }} signal, high, inner;
        {{ count }} *line = state->line[m];

        first = {{ NAME }}_N_PATCHES * LINK[m];
        sum = 0;
        for (k = 0; k < {{ NAME }}_N_PATCHES; k++) {
            sum += ({{ wide }})FILTER[m][k] * sensed[first + k];
        }
        signal = limited(shifted(sum, FILTER_SHIFT[m]));
        sum = shifted(({{ wide }})HIGH_PASS[m][0] * signal, HIGH_PASS_SHIFT[m][0]);
        high = limited(sum + state->high[m]);
        sum = ({{ wide }})HIGH_PASS[m][1] * signal + ({{ wide }})HIGH_PASS[m][2] * high;
        state->high[m] = limited(shifted(sum, HIGH_PASS_SHIFT[m][1]));
        sum = ({{ wide }})LOW_PASS[m][0] * high + ({{ wide }})LOW_PASS[m][1] * line[0]
            + ({{ wide }})LOW_PASS[m][2] * line[1];
        inner = limited(shifted(sum, LOW_PASS_SHIFT[m]));
        sum = ({{ wide }})FORCE[m][0] * inner + ({{ wide }})FORCE[m][1] * line[0]
            + ({{ wide }})FORCE[m][2] * line[1]
            {%- if channels.has_direct +%}
            + ({{ wide }})DIRECT[m] * signal
            {%- endif %};
        force[m] = limited(shifted(sum, FORCE_SHIFT[m]));
        {% if fixed.energy %}
        energy[m] = 0;
        for (k = 0; k < 2; k++) {
            {{ wide }} part;

            sum = ({{ wide }})ENERGY[2 * m + k][0] * inner + ({{ wide }})ENERGY[2 * m + k][1] * line[0]
                + ({{ wide }})ENERGY[2 * m + k][2] * line[1] + ({{ wide }})ENERGY[2 * m + k][3] * signal;
            part = limited(shifted(sum, ENERGY_SHIFT[2 * m + k]));
            energy[m] += part * part;
        }
        {% endif %}
        line[1] = line[0];
        line[0] = inner;
    }
    {% if fixed.energy %}
    for (m = 0; m < {{ NAME }}_N_MODES; m++) {
        for (k = 0; k < {{ NAME }}_N_MODES; k++) {
            if (IS_RIVAL[m] && IS_RIVAL[k] && LINK[k] == LINK[m] && energy[k] > energy[m]) {
                force[m] = 0;
            }
        }
    }
    {% endif %}
    {% endif %}
    for (k = 0; k < {{ NAME }}_N_CHANNELS; k++) {
        int32_t command;

        {% if blocks %}
        command = within(wanted[k]);
        {% else %}
        sum = 0;
        for (m = FIRST_MODE[k / {{ NAME }}_N_PATCHES]; m < FIRST_MODE[k / {{ NAME }}_N_PATCHES + 1]; m++) {
            sum += ({{ wide }})SYNTHESIZER[m][k % {{ NAME }}_N_PATCHES] * force[m];
        }
        command = within(shifted(sum, SYNTHESIZER_SHIFT[k]));
        {% endif %}
        {% if has_feedthrough %}
        state->command[k] = ({{ count }})command;
        {% endif %}
        actuator[k] = (uint16_t)(command + DAC_REST);
    }
    return 0;
}

void {{ name }}_shape_step({{ name }}_shaper *shaper, const int32_t reference[{{ NAME }}_N_POSE], int32_t shaped[{{ NAME }}_N_POSE])
{
    int64_t sum[{{ NAME }}_N_POSE] = {0};
    uint32_t at, last;
    int k, axis;

    {{ shared.advance() }}
    for (axis = 0; axis < {{ NAME }}_N_POSE; axis++) {
        shaper->past[shaper->newest][axis] = reference[axis];
    }
    for (k = 0; k < N_TAPS; k++) {
        at = shaper->newest + DELAY[k];
        if (at >= {{ NAME }}_SHAPER_LENGTH) {
            at -= {{ NAME }}_SHAPER_LENGTH;
        }
        for (axis = 0; axis < {{ NAME }}_N_POSE; axis++) {
            sum[axis] += (int64_t)WEIGHT[k] * shaper->past[at][axis];
        }
    }
    for (axis = 0; axis < {{ NAME }}_N_POSE; axis++) {
        shaped[axis] = {{ pose }}limited({{ pose }}shifted(sum[axis], WEIGHT_SHIFT));
    }
}
