/* Controller and input shaper, see $name.h.
 *
$origin
 *
 * Each constant: [unit], and the section or field of the study file that it comes from.
 */
#include "$name.h"

#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__
#error "compile without -ffast-math and -ffinite-math-only: they leave out the check for NaN"
#endif

typedef ${name}_real real;
#define R(x) ((real)(x))

$tables

/* Whether a sensor is faulty: its number from 1, else 0. A NaN fails every comparison. */
static int check(${name}_state *state, const real sensor[${NAME}_N_CHANNELS])
{
    int16_t *at;
    int k;

    for (k = 0; k < ${NAME}_N_CHANNELS; k++) {
        if (!IS_USED[k / ${NAME}_N_PATCHES]) {
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
        if (*at >= ${NAME}_RAIL_SAMPLES || *at <= -${NAME}_RAIL_SAMPLES) {
            return k + 1;
        }
    }
    return 0;
}

$state

int ${name}_step(${name}_state *state, const real sensor[${NAME}_N_CHANNELS],
    real actuator[${NAME}_N_CHANNELS])
{
    real volt[${NAME}_N_CHANNELS]; /* of the sensors [V] */
    real wanted[${NAME}_N_CHANNELS]; /* of the actuators, without limit [V] */
$rivals    int k, m, first;

    if (!state->fault) {
        state->fault = check(state, sensor);
    }
    if (state->fault) {
        forget(state);
        for (k = 0; k < ${NAME}_N_CHANNELS; k++) {
            actuator[k] = 0;
        }
        return state->fault;
    }
    for (k = 0; k < ${NAME}_N_CHANNELS; k++) {
        volt[k] = IS_USED[k / ${NAME}_N_PATCHES] ? (sensor[k] - BIAS) / CONDITIONER_GAIN : 0;
        wanted[k] = 0;
    }
$subtract_feedthrough    for (m = 0; m < ${NAME}_N_MODES; m++) {
        real signal = 0, high, inner, force$more_reals;
        real *line = state->line[m];

        first = ${NAME}_N_PATCHES * LINK[m];
        for (k = 0; k < ${NAME}_N_PATCHES; k++) {
            signal += FILTER[m][k] * volt[first + k];
        }
        high = HIGH_PASS[m][0] * signal + state->high[m];
        state->high[m] = HIGH_PASS[m][1] * signal - HIGH_PASS[m][2] * high;
        inner = high - LOW_PASS[m][0] * line[0] - LOW_PASS[m][1] * line[1];
        force = FORCE[m][0] * inner + FORCE[m][1] * line[0] + FORCE[m][2] * line[1]$direct;
$weigh        line[1] = line[0];
        line[0] = inner;
$apply    }
$choose    for (k = 0; k < ${NAME}_N_CHANNELS; k++) {
        if (wanted[k] > LIMIT) {
            wanted[k] = LIMIT;
        } else if (wanted[k] < -LIMIT) {
            wanted[k] = -LIMIT;
        }
$keep_command        actuator[k] = wanted[k];
    }
    return 0;
}

void ${name}_shape_step(${name}_shaper *shaper, const real reference[3], real shaped[3])
{
    real sum[3] = {0, 0, 0};
    uint32_t at;
    int k, axis;

    shaper->newest = (shaper->newest == 0 ? ${NAME}_SHAPER_LENGTH : shaper->newest) - 1;
    for (axis = 0; axis < 3; axis++) {
        shaper->past[shaper->newest][axis] = reference[axis];
    }
    for (k = 0; k < N_TAPS; k++) {
        at = shaper->newest + DELAY[k];
        if (at >= ${NAME}_SHAPER_LENGTH) {
            at -= ${NAME}_SHAPER_LENGTH;
        }
        for (axis = 0; axis < 3; axis++) {
            sum[axis] += WEIGHT[k] * shaper->past[at][axis];
        }
    }
    for (axis = 0; axis < 3; axis++) {
        shaped[axis] = sum[axis];
    }
}
