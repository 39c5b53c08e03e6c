/* What campaigns on exported code share. Compile with -DUSED=<bit of each controlled link>,
 * -DREST=<code of a sensor at rest>, and -DFIXED or not.
 */
#include <math.h>
#include <stdint.h>

#include "flexlink.h"

#define N FLEXLINK_N_CHANNELS
#define TOP FLEXLINK_ADC_TOP
#define IS_USED(k) ((USED) >> ((k) / FLEXLINK_N_PATCHES) & 1)

#ifdef FIXED
typedef uint16_t wire;
typedef int32_t pose_word;
#define AT_REST FLEXLINK_DAC_REST
#else
typedef flexlink_real wire;
typedef flexlink_real pose_word;
#define AT_REST 0
#endif

static uint64_t random_state = 1;

static uint64_t any(void) /* xorshift64 */
{
    random_state ^= random_state << 13;
    random_state ^= random_state >> 7;
    random_state ^= random_state << 17;
    return random_state >> 11;
}

static int below(int count)
{
    return (int)(any() % (uint64_t)count);
}

static wire of_code(int32_t code)
{
#ifdef FIXED
    return (wire)code;
#else
    const wire denormal = (wire)(sizeof(wire) == 8 ? 1e-310 : 1e-40);

    return code > 0 ? (wire)(code * FLEXLINK_ADC_STEP) : denormal; /* stands for 0 as well as 0 does */
#endif
}

static int is_inside(wire actuator)
{
#ifdef FIXED
    return actuator >= 1 && actuator <= 2 * FLEXLINK_DAC_REST - 1;
#else
    return actuator >= (wire)-FLEXLINK_LIMIT && actuator <= (wire)FLEXLINK_LIMIT;
#endif
}
