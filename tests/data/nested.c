/* On a processor: steps of one instance under a timer's interrupts that call another one.
 *
 * Ends well if both give what they give alone, if as many interrupts came in the middle of a step as
 * there are samples, and if interrupts that call the same instance leave its outputs in their range
 * and its neighbours in memory alone.
 */
#include "exported.h"

#define SAMPLES 400
#define GUARD 0xA5C3A5C3u
#define SYSTICK_CONTROL (*(volatile uint32_t *)0xE000E010u)
#define SYSTICK_RELOAD (*(volatile uint32_t *)0xE000E014u)
#define SYSTICK_VALUE (*(volatile uint32_t *)0xE000E018u)

typedef struct {
    uint32_t before;
    flexlink_state state;
    uint32_t between;
    flexlink_shaper shaper;
    uint32_t after;
    uint64_t seed; /* of the next sensors */
    uint32_t hash; /* of all results */
    int32_t count; /* of samples */
} instance;

void fault_handler(void);
void timer_handler(void);

static instance first, second;
static volatile int32_t hits, is_inside_step, is_same;
static uint32_t span; /* of a step [ticks] */

static void end(int is_good)
{
    register int r0 __asm__("r0") = 0x18;
    register uint32_t r1 __asm__("r1") = is_good ? 0x20026u : 0x20023u;

    for (;;) {
        __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
    }
}

void fault_handler(void)
{
    end(0);
}

static void begin(instance *at, uint64_t seed)
{
    const pose_word pose[FLEXLINK_N_POSE] = {0};

    at->before = at->between = at->after = GUARD;
    flexlink_init(&at->state);
    flexlink_shape_init(&at->shaper, pose);
    at->seed = seed;
    at->hash = 0;
    at->count = 0;
}

/* FNV-1a of what an instance says. */
static void add(instance *at, const void *data, uint32_t bytes)
{
    uint32_t k;

    for (k = 0; k < bytes; k++) {
        at->hash = (at->hash ^ ((const uint8_t *)data)[k]) * 16777619u;
    }
}

static void step(instance *at)
{
    wire in[N], out[N];
    pose_word pose[FLEXLINK_N_POSE] = {0}, shaped[FLEXLINK_N_POSE];
    int k, fault;

    random_state = at->seed;
    for (k = 0; k < N; k++) {
        in[k] = of_code(1 + below(TOP - 1));
    }
    pose[0] = (pose_word)below(1000000);
    at->seed = random_state;
    fault = flexlink_step(&at->state, in, out);
    flexlink_shape_step(&at->shaper, pose, shaped);
    for (k = 0; k < N; k++) {
        if (!is_inside(out[k])) {
            end(0);
        }
    }
    add(at, out, sizeof out);
    add(at, shaped, sizeof shaped);
    add(at, &fault, sizeof fault);
    at->count++;
}

/* The next interrupt comes at any place of a step; the processor has time for both instances. */
void timer_handler(void)
{
    const uint64_t seed = random_state;

    hits += is_inside_step;
    step(is_same ? &first : &second);
    random_state = seed;
    SYSTICK_RELOAD = 2u * span + (first.hash ^ second.hash) % span;
}

static uint32_t alone(uint64_t seed, int32_t count)
{
    begin(&first, seed);
    while (first.count < count) {
        step(&first);
    }
    return first.hash;
}

static void run_under_interrupts(void)
{
    begin(&first, 1);
    begin(&second, 2);
    hits = 0;
    SYSTICK_RELOAD = 2u * span;
    SYSTICK_VALUE = 0;
    SYSTICK_CONTROL = 7; /* on, by the processor's clock, with interrupt */
    while (hits < SAMPLES) {
        is_inside_step = 1;
        step(&first);
        is_inside_step = 0;
    }
    SYSTICK_CONTROL = 0;
    if (first.before != GUARD || first.between != GUARD || first.after != GUARD) {
        end(0);
    }
}

int main(void)
{
    uint32_t found[2];
    int32_t counts[2];

    SYSTICK_RELOAD = 0xFFFFFFu;
    SYSTICK_VALUE = 0;
    SYSTICK_CONTROL = 5; /* on, without interrupt */
    begin(&first, 1);
    span = SYSTICK_VALUE;
    step(&first);
    span = (span - SYSTICK_VALUE) & 0xFFFFFFu;

    run_under_interrupts();
    found[0] = first.hash;
    found[1] = second.hash;
    counts[0] = first.count;
    counts[1] = second.count;
    if (alone(1, counts[0]) != found[0] || alone(2, counts[1]) != found[1]) {
        end(0);
    }
    is_same = 1;
    run_under_interrupts();
    end(1);
}
