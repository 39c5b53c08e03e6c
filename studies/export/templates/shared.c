{# Pieces that floating and fixed point have in common. #}
{% macro needs_nan() %}
#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__
#error "compile without -ffast-math and -ffinite-math-only: they leave out the check for NaN"
#endif
{%- endmacro %}

{% macro structure() %}
/* 1: link is controlled; control.links */
static const uint16_t IS_USED{{ array(is_used) }};

{% if blocks %}
/* systems, states of each, sensors and actuators of each; control.links */
#define N_SYSTEMS {{ blocks.first | length }}
#define ORDER {{ order }}
#define BLOCK {{ block }}
#define N_PORTS {{ n_ports }}

/* first sensor and actuator of each system */
static const uint16_t FIRST{{ array(blocks.first) }};
{%- else %}
/* link of each controlled mode, from 0; control */
static const uint16_t LINK{{ array(channels.link) }};
{%- endif %}
{%- endmacro %}

{% macro taps(type, weight) %}
/* taps of the input shaper {{ shaper }}; shaper */
#define N_TAPS {{ weight | length }}

/* [1] of each tap of the input shaper {{ shaper }}; shaper */
static const {{ type }} WEIGHT{{ array(weight) }};

/* [samples] of each tap of the input shaper {{ shaper }}; shaper */
static const uint32_t DELAY{{ array(delay) }};
{%- endmacro %}

{% macro rivals() %}
/* 1: acts while no other channel of its link has more energy; control.law */
static const uint16_t IS_RIVAL{{ array(is_rival) }};
{%- endmacro %}

{% macro first_section() %}
{% if electronics.estimator == "difference" %}
difference behind a low-pass; electronics.difference_cutoff_hz
{%- else %}
high-pass; electronics.highpass_hz
{%- endif %}
{%- endmacro %}

{% macro second_section() %}
{% if electronics.estimator == "difference" %}
no second section for the estimator `difference`
{%- else %}
low-pass; electronics.lowpass_ratio, lowpass_zeta, antialias_hz
{%- endif %}
{%- endmacro %}

{% macro state(reference) %}
static void forget({{ name }}_state *state)
{
    int k;

    {% if blocks %}
    for (k = 0; k < {{ NAME }}_N_STATES; k++) {
        state->x[k] = 0;
    }
    {% else %}
    for (k = 0; k < {{ NAME }}_N_MODES; k++) {
        state->high[k] = 0;
        state->line[k][0] = 0;
        state->line[k][1] = 0;
    }
    {% endif %}
    for (k = 0; k < {{ NAME }}_N_CHANNELS; k++) {
        {% if has_feedthrough %}
        state->command[k] = 0;
        {% endif %}
        state->rail[k] = 0;
    }
}

void {{ name }}_init({{ name }}_state *state)
{
    forget(state);
    state->fault = 0;
}

void {{ name }}_shape_init({{ name }}_shaper *shaper, const {{ word }} reference[{{ NAME }}_N_POSE])
{
    uint32_t k;
    int axis;

    for (k = 0; k < {{ NAME }}_SHAPER_LENGTH; k++) {
        for (axis = 0; axis < {{ NAME }}_N_POSE; axis++) {
            shaper->past[k][axis] = {{ reference }};
        }
    }
    shaper->newest = 0;
}
{%- endmacro %}

{% macro advance() %}
last = shaper->newest < {{ NAME }}_SHAPER_LENGTH ? shaper->newest : 0; /* anything, before init */
    shaper->newest = (last == 0 ? {{ NAME }}_SHAPER_LENGTH : last) - 1;
{%- endmacro %}
