/* Vibration controller of a planar 3-PRR robot with flexible links.
 *
$origin
 *
 * Once per sample, at $rate Hz:
 *   1. put the actuator values of the last call on the actuators, and sample all sensors;
 *   2. call ${name}_step; its actuator values go out at the next sample.
 * That one sample of delay is part of the design. Begin with ${name}_init.
 *
 * Wires: $n_patches patch pairs per link, link 1 first, each link's from the slider to the platform.
 * Front end: ADC of $adc_bits bits for 0 to $adc_range V; before it a conditioner of gain $gain and bias
 * $bias V, and a second-order Butterworth filter at $antialias Hz, which the design counts on.
 * Polarity: a positive voltage at actuator n must raise sensor n.
$border
 * Start: amplifiers off, ${name}_init, then ${name}_step for ${NAME}_SETTLE_SAMPLES samples.
 *
 * No allocation, no recursion, no library; all memory is in the two structures below.
 */
#ifndef ${NAME}_H
#define ${NAME}_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

$types
#define ${NAME}_N_LINKS $n_links
#define ${NAME}_N_PATCHES $n_patches
#define ${NAME}_N_CHANNELS $n_channels
#define ${NAME}_N_MODES $n_modes /* controlled $kind of all links together */
#define ${NAME}_SAMPLE_RATE $rate_literal /* Hz */
#define ${NAME}_RAIL_SAMPLES $rail /* $rail_ms ms at one end of its range: a faulty sensor */
#define ${NAME}_SETTLE_SAMPLES $settle /* until the filters have forgotten 99.99 % of the start */
#define ${NAME}_SHAPER_LENGTH $shaper_length /* samples that the shaper remembers */
$constants

/* What the controller remembers from sample to sample. */
typedef struct {
$members
    int16_t rail[${NAME}_N_CHANNELS]; /* consecutive samples at the top, or minus those at 0 */
    int fault; /* number of the first faulty sensor, from 1; 0: none */
} ${name}_state;

/* Forget everything, faults too: the state of a machine at rest. */
void ${name}_init(${name}_state *state);

/* One sample: sensors in, values for the actuators of the next sample out.
 *
 * Returns 0, or the number (from 1) of a faulty sensor:
 * $faulty.
 * From then on all actuators are at rest, whatever the sensors say, until ${name}_init. Sensors of
 * links that are not controlled are not looked at; their actuators stay at rest.
 */
int ${name}_step(${name}_state *state, const $sensor_type sensor[${NAME}_N_CHANNELS],
    $actuator_type actuator[${NAME}_N_CHANNELS]);

/* What the shaper remembers: references of the past, newest at `newest`. */
typedef struct {
    $reference_type past[${NAME}_SHAPER_LENGTH][3];
    uint32_t newest;
} ${name}_shaper;

/* Begin at rest in a pose. */
void ${name}_shape_init(${name}_shaper *shaper, const $reference_type reference[3]);

/* One sample of the reference pose (x, y, phi)$reference_unit: as planned in, shaped out. */
void ${name}_shape_step(${name}_shaper *shaper, const $reference_type reference[3],
    $reference_type shaped[3]);

#ifdef __cplusplus
}
#endif

#endif
