{% set kinds = "patches" if channels and channels.kind == "patch" else "modes" %}
/* Vibration controller of a planar {{ machine }} robot with flexible links.
 *
{% for line in origin %}
 * {{ line }}
{% endfor %}
 *
 * Once per sample, at {{ electronics.sample_rate_hz | short(6) }} Hz:
 *   1. put the actuator values of the last call on the actuators, and sample all sensors;
 *   2. call {{ name }}_step; its actuator values go out at the next sample.
 * That one sample of delay is part of the design. Begin with {{ name }}_init.
 *
 * Wires: {{ n_patches }} patch pairs per link, link 1 first; on each link from slider to platform.
 * Polarity: a positive voltage at actuator n must raise sensor n.
 * Front end assumed by the design:
 *   - a second-order Butterworth filter at {{ electronics.antialias_hz | short(6) }} Hz;
 *   - a conditioner of gain {{ electronics.conditioner_gain | short(6) }};
 *   - a bias of {{ electronics.conditioner_bias | short(6) }} V at the ADC;
 *   - an ADC of {{ electronics.adc_bits }} bits for 0 to {{ electronics.adc_range | short(6) }} V.
{% if fixed %}
 * Sensors: codes of the ADC, 0 to {{ fixed.wires.adc_top }}. A sensor is faulty if its code is too
 * high, or too long at one end of the range.
 * Actuators: codes of the DAC, 1 to {{ 2 * fixed.wires.dac_rest - 1 }}, which span
 * +-{{ electronics.voltage_limit | short(6) }} V at the piezo patch; {{ fixed.wires.dac_rest }} is 0 V.
{% else %}
 * Sensors: volts at the ADC's input, the code times {{ NAME }}_ADC_STEP; conditioner gain and
 * bias are removed here. A sensor is faulty if it is NaN or out of range, or too long at one end
 * of it.
 * Actuators: volts at the piezo patch, so divide by the gain of the amplifier.
{% endif %}
 * Start: amplifiers off, {{ name }}_init, then {{ NAME }}_SETTLE_SAMPLES times {{ name }}_step.
 *
 * No allocation, no recursion, no library; all memory is in the two structures below. So a call may
 * interrupt one for another instance. If it interrupts one for the same instance, no other memory is
 * touched, but results mean nothing, and a fault may be lost.
 */
#ifndef {{ NAME }}_H
#define {{ NAME }}_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

{% if not fixed %}
/* double, or float with -D{{ NAME }}_REAL=float. */
#ifndef {{ NAME }}_REAL
#define {{ NAME }}_REAL double
#endif
typedef {{ NAME }}_REAL {{ name }}_real;
{% endif %}

#define {{ NAME }}_N_LINKS {{ n_links }}
#define {{ NAME }}_N_POSE {{ n_pose }} /* coordinates of a reference */
#define {{ NAME }}_N_PATCHES {{ n_patches }}
#define {{ NAME }}_N_CHANNELS {{ n_links * n_patches }}
{% if blocks %}
#define {{ NAME }}_N_STATES {{ blocks.names | length }} /* of all systems */
{% else %}
#define {{ NAME }}_N_MODES {{ channels.link | length }} /* controlled {{ kinds }} of all links */
{% endif %}
#define {{ NAME }}_SAMPLE_RATE {{ exact(electronics.sample_rate_hz) }} /* Hz */
#define {{ NAME }}_RAIL_SAMPLES {{ rail }} /* {{ rail_ms }} ms at one end: a faulty sensor */
#define {{ NAME }}_SETTLE_SAMPLES {{ settle }} /* until 99.99 % of the initial transient has decayed */
#define {{ NAME }}_SHAPER_LENGTH {{ shaper_length }} /* samples stored by the shaper */
{% if fixed %}
#define {{ NAME }}_ADC_TOP {{ fixed.wires.adc_top }} /* highest code */
#define {{ NAME }}_DAC_REST {{ fixed.wires.dac_rest }} /* code of 0 V */
#define {{ NAME }}_DAC_STEP {{ exact(fixed.wires.dac_step) }} /* V per code at the patch */
{% else %}
#define {{ NAME }}_ADC_TOP {{ controller.adc_top | int }} /* highest code */
#define {{ NAME }}_ADC_STEP {{ exact(controller.adc_step) }} /* V per code */
#define {{ NAME }}_LIMIT {{ exact(controller.voltage_limit) }} /* V, of every actuator, +- */
{% endif %}

/* State of the controller. */
typedef struct {
    {% if blocks %}
    {{ count }} x[{{ NAME }}_N_STATES]; /* pairs that turn together */
    {% else %}
    {{ count }} high[{{ NAME }}_N_MODES]; /* memory of the first section */
    {{ count }} line[{{ NAME }}_N_MODES][2]; /* delay line of the second section */
    {% endif %}
    {% if has_feedthrough %}
    {{ count }} command[{{ NAME }}_N_CHANNELS]; /* on the actuators now */
    {% endif %}
    int16_t rail[{{ NAME }}_N_CHANNELS]; /* consecutive samples at the top, or minus those at 0 */
    int fault; /* number of the first faulty sensor, from 1; 0: none */
} {{ name }}_state;

/* Reset everything, including faults: the state of a machine at rest. Without it, the results
 * of {{ name }}_step mean nothing, but no other memory is touched. */
void {{ name }}_init({{ name }}_state *state);

/* One sample: sensors in, values for the actuators of the next sample out.
 *
 * Returns 0, or the number (from 1) of a faulty sensor:
{% if fixed %}
 * a code beyond the ADC's, or stuck at one end.
{% else %}
 * not a number, out of range or stuck at one end of it.
{% endif %}
 * From then on all actuators are at rest, whatever the sensors say, until {{ name }}_init. Sensors
 * of uncontrolled links are ignored; their actuators stay at rest.
 */
int {{ name }}_step({{ name }}_state *state, const {{ wire }} sensor[{{ NAME }}_N_CHANNELS],
    {{ wire }} actuator[{{ NAME }}_N_CHANNELS]);

/* State of the shaper: past references, newest at `newest`. */
typedef struct {
    {{ word }} past[{{ NAME }}_SHAPER_LENGTH][{{ NAME }}_N_POSE];
    uint32_t newest;
} {{ name }}_shaper;

/* Start at rest in a pose{% if not fixed %}; one that is not finite counts as zero{% endif %}. Without it, the result of
 * {{ name }}_shape_step means nothing, but stays inside the structure. */
void {{ name }}_shape_init({{ name }}_shaper *shaper, const {{ word }} reference[{{ NAME }}_N_POSE]);

/* One sample of the reference pose (x, y, phi): as planned in, shaped out.
{% if fixed %}
 * In any units that fit 32 bits.
{% else %}
 * In any units. A reference with a coordinate that is not finite is replaced by the last finite one.
{% endif %}
 */
void {{ name }}_shape_step({{ name }}_shaper *shaper, const {{ word }} reference[{{ NAME }}_N_POSE],
    {{ word }} shaped[{{ NAME }}_N_POSE]);

#ifdef __cplusplus
}
#endif

#endif
