/* Throw arbitrary numbers at exported code: -DFIXED or floating, first argument: samples, second: seed.
 * Fails where an output leaves its range; sanitizers watch the rest.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "flexlink.h"

static uint64_t state = 1;

static uint64_t any(void) /* xorshift64 */
{
    state ^= state << 13;
    state ^= state >> 7;
    state ^= state << 17;
    return state;
}

#ifdef FIXED
typedef uint16_t sensor_t;
typedef int32_t reference_t;

static sensor_t sensor(uint64_t kind)
{
    uint16_t code = (uint16_t)(any() % (FLEXLINK_ADC_TOP + 1));
    switch (kind) {
    case 0: return (uint16_t)any(); /* beyond the ADC, mostly */
    case 1: return 0;
    case 2: return FLEXLINK_ADC_TOP;
    default: return code;
    }
}

static reference_t reference(void)
{
    uint64_t x = any();
    switch (x >> 60) {
    case 0: return INT32_MAX;
    case 1: return INT32_MIN;
    default: return (int32_t)(uint32_t)x;
    }
}

static int is_off(reference_t value)
{
    (void)value;
    return 0;
}

static int is_bad(uint16_t value)
{
    return value < 1 || value > 2 * FLEXLINK_DAC_REST - 1;
}
#else
typedef flexlink_real sensor_t;
typedef flexlink_real reference_t;

static sensor_t bits(void) /* any bit pattern: NaN, infinities, denormals */
{
    sensor_t value;
    uint64_t x = any();
    memcpy(&value, &x, sizeof value);
    return value;
}

static sensor_t sensor(uint64_t kind)
{
    switch (kind) {
    case 0: return bits();
    case 1: return 0;
    case 2: return (sensor_t)(FLEXLINK_ADC_TOP * FLEXLINK_ADC_STEP);
    default: return (sensor_t)((double)(any() % (FLEXLINK_ADC_TOP + 1)) * FLEXLINK_ADC_STEP);
    }
}

static int is_off(reference_t value)
{
    return !(value - value <= 0);
}

static reference_t reference(void)
{
    return any() % 8 ? (reference_t)((double)(int32_t)(uint32_t)any() * 1e-9) : bits();
}

static int is_bad(sensor_t value)
{
    return !(value >= -FLEXLINK_LIMIT && value <= FLEXLINK_LIMIT);
}
#endif

int main(int count, char **words)
{
    long samples = count > 1 ? atol(words[1]) : 100000, k;
    long faults = 0, held = 0;
    flexlink_state controller;
    flexlink_shaper shaper;
    sensor_t in[FLEXLINK_N_CHANNELS], out[FLEXLINK_N_CHANNELS];
    reference_t pose[3], shaped[3];
    int c, fault;

    state = 0x9E3779B97F4A7C15u ^ (uint64_t)(count > 2 ? atol(words[2]) : 1);
    memset(&controller, 0xA5, sizeof controller); /* init must not rely on what is there */
    memset(&shaper, 0xA5, sizeof shaper);
    flexlink_init(&controller);
    for (c = 0; c < 3; c++) {
        pose[c] = reference();
    }
    flexlink_shape_step(&shaper, pose, shaped); /* before init: whatever comes, nothing breaks */
    flexlink_shape_init(&shaper, pose);
    for (k = 0; k < samples; k++) {
        uint64_t phase = (any() >> 20) % 4096; /* 0: anything at all, 1: stuck at an end */
        if (held > 0) {
            held--;
        } else {
            uint64_t end = 1 + any() % 2;
            for (c = 0; c < FLEXLINK_N_CHANNELS; c++) {
                in[c] = sensor(phase == 0 ? any() % 3 : phase == 1 ? end : 1 + any() % 3);
            }
            held = phase == 1 ? 2 * FLEXLINK_RAIL_SAMPLES : 0;
        }
        fault = flexlink_step(&controller, in, out);
        if (fault < 0 || fault > FLEXLINK_N_CHANNELS) {
            printf("fault %d at sample %ld\n", fault, k);
            return 1;
        }
        for (c = 0; c < FLEXLINK_N_CHANNELS; c++) {
            if (is_bad(out[c])) {
                printf("actuator %d out of range at sample %ld\n", c + 1, k);
                return 1;
            }
        }
        if (fault && any() % 64 == 0) {
            faults++;
            flexlink_init(&controller);
        }
        for (c = 0; c < 3; c++) {
            pose[c] = reference();
        }
        flexlink_shape_step(&shaper, pose, shaped);
        for (c = 0; c < 3; c++) {
            if (is_off(shaped[c])) {
                printf("reference %d is not finite at sample %ld\n", c + 1, k);
                return 1;
            }
        }
    }
    printf("%ld samples, %ld faults\n", samples, faults);
    return 0;
}
