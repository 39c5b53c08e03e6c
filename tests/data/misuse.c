/* What may go wrong around exported code: no init, init again, two instances at once, interrupts.
 *
 * Arguments: samples, interrupts, seed. Compile as exported.h says, with sanitizers.
 */
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/time.h>

#include "exported.h"

#define SHAPED FLEXLINK_N_POSE
#define PERIOD 20 /* of the timer [us] */

/* One instance, allocated, so that a step beyond it is seen; what goes in and what comes out. */
typedef struct {
    flexlink_state *state;
    flexlink_shaper *shaper;
    wire *in, *out; /* of all samples */
    pose_word *pose, *shaped;
    int *fault;
    volatile long at;
} instance;

static long samples;
static instance first, second;
static volatile sig_atomic_t is_inside_step, hits, misses;

static void fail(const char *what, long at)
{
    printf("%s %ld\n", what, at);
    exit(1);
}

static void *allocated(size_t bytes)
{
    void *memory = malloc(bytes);

    if (!memory) {
        exit(2);
    }
    return memory;
}

/* Codes that now and then stay at an end for long enough to be a fault. */
static void fill(instance *at)
{
    long k;
    int c, held[N] = {0};

    for (k = 0; k < samples; k++) {
        for (c = 0; c < N; c++) {
            held[c] -= held[c] > 0;
            if (!held[c] && below(20000) == 0) {
                held[c] = 2 * FLEXLINK_RAIL_SAMPLES;
            }
            at->in[N * k + c] = of_code(held[c] ? TOP : below(TOP + 1));
        }
        for (c = 0; c < SHAPED; c++) {
            at->pose[SHAPED * k + c] = (pose_word)(below(2000000) - 1000000);
        }
    }
}

static void make(instance *at)
{
    const size_t count = (size_t)samples;

    at->state = allocated(sizeof *at->state);
    at->shaper = allocated(sizeof *at->shaper);
    at->in = allocated(count * N * sizeof *at->in);
    at->out = allocated(count * N * sizeof *at->out);
    at->pose = allocated(count * SHAPED * sizeof *at->pose);
    at->shaped = allocated(count * SHAPED * sizeof *at->shaped);
    at->fault = allocated(count * sizeof *at->fault);
    fill(at);
}

static void begin(instance *at)
{
    flexlink_init(at->state);
    flexlink_shape_init(at->shaper, at->pose);
    at->at = 0;
}

/* One sample; a fault is followed by init some samples later. */
static void step(instance *at)
{
    const long k = at->at;

    at->fault[k] = flexlink_step(at->state, at->in + N * k, at->out + N * k);
    flexlink_shape_step(at->shaper, at->pose + SHAPED * k, at->shaped + SHAPED * k);
    if (at->fault[k] && k % 16 == 0) {
        flexlink_init(at->state);
    }
    at->at = k + 1;
}

/* All samples so far are those of the instance alone. */
static void compare(const instance *at, const char *what)
{
    instance alone;
    const size_t n = (size_t)at->at;

    alone = *at;
    alone.state = allocated(sizeof *alone.state);
    alone.shaper = allocated(sizeof *alone.shaper);
    alone.out = allocated(n * N * sizeof *alone.out);
    alone.shaped = allocated(n * SHAPED * sizeof *alone.shaped);
    alone.fault = allocated(n * sizeof *alone.fault);
    begin(&alone);
    while ((size_t)alone.at < n) {
        step(&alone);
    }
    if (memcmp(alone.out, at->out, n * N * sizeof *at->out)
        || memcmp(alone.fault, at->fault, n * sizeof *at->fault)
        || memcmp(alone.shaped, at->shaped, n * SHAPED * sizeof *at->shaped)) {
        fail(what, (long)n);
    }
    free(alone.state);
    free(alone.shaper);
    free(alone.out);
    free(alone.shaped);
    free(alone.fault);
}

/* --- memory that init has not seen ------------------------------------------------------------ */

/* Without init nothing is promised but that the structures are not left; init then makes all good.
 * byte: what memory is full of; -1: of anything. is_cleared: but there is no fault. */
static void forget_init(int byte, int is_cleared)
{
    size_t k;
    long sample;

    for (k = 0; k < sizeof *first.state; k++) {
        ((unsigned char *)first.state)[k] = (unsigned char)(byte < 0 ? below(256) : byte);
    }
    for (k = 0; k < sizeof *first.shaper; k++) {
        ((unsigned char *)first.shaper)[k] = (unsigned char)(byte < 0 ? below(256) : byte);
    }
    first.state->fault = is_cleared ? 0 : first.state->fault;
    first.at = 0;
    for (sample = 0; sample < samples && sample < 300; sample++) {
        step(&first);
    }
    begin(&first);
    for (sample = 0; sample < samples && sample < 300; sample++) {
        step(&first);
    }
    compare(&first, "init after litter: other samples of");
}

static void init_twice(void)
{
    begin(&first);
    step(&first);
    begin(&first);
    begin(&first);
    while (first.at < samples / 4) {
        step(&first);
    }
    compare(&first, "init twice: other samples of");
}

/* --- two at once ------------------------------------------------------------------------------ */

static void interleave(void)
{
    begin(&first);
    begin(&second);
    while (first.at < samples && second.at < samples) {
        step(below(2) ? &first : &second);
    }
    compare(&first, "interleaved: other samples of the first,");
    compare(&second, "interleaved: other samples of the second,");
}

static void count_interrupt(void)
{
    if (is_inside_step) {
        hits++;
    } else {
        misses++;
    }
}

static void step_second(int number)
{
    (void)number;
    count_interrupt();
    if (second.at == samples) {
        begin(&second);
    }
    step(&second);
}

static void step_first(int number)
{
    wire in[N], out[N];
    pose_word pose[SHAPED] = {0}, shaped[SHAPED];
    int k;

    (void)number;
    count_interrupt();
    for (k = 0; k < N; k++) {
        in[k] = of_code(hits % 2 ? TOP : 0);
    }
    (void)flexlink_step(first.state, in, out);
    flexlink_shape_step(first.shaper, pose, shaped);
    for (k = 0; k < N; k++) {
        if (!is_inside(out[k])) {
            abort();
        }
    }
}

/* Steps of the first instance under a timer's interrupts, in the middle of them. */
static void interrupted(void (*handler)(int), long most)
{
    const struct itimerval on = {{0, PERIOD}, {0, PERIOD}}, off = {{0, 0}, {0, 0}};
    struct sigaction action;
    long k, c;

    memset(&action, 0, sizeof action);
    action.sa_handler = handler;
    hits = 0;
    begin(&first);
    begin(&second);
    if (sigaction(SIGALRM, &action, NULL) || setitimer(ITIMER_REAL, &on, NULL)) {
        exit(2);
    }
    while (hits < most) {
        k = first.at == samples ? 0 : first.at;
        if (k == 0) {
            is_inside_step = 0;
            begin(&first);
        }
        is_inside_step = 1;
        step(&first);
        is_inside_step = 0;
        for (c = 0; c < N; c++) {
            if (!is_inside(first.out[N * k + c])) {
                fail("under interrupts: beyond the limits at sample", k);
            }
        }
    }
    if (setitimer(ITIMER_REAL, &off, NULL)) {
        exit(2);
    }
}

int main(int count, char **arguments)
{
    long interrupts;
    const int bytes[] = {0x00, 0xFF, 0x7F, 0x80, 0x01, -1, -1, -1};
    size_t kind;

    if (count != 4) {
        return 2;
    }
    samples = atol(arguments[1]);
    interrupts = atol(arguments[2]);
    random_state = UINT64_C(0x9E3779B97F4A7C15) ^ (uint64_t)atol(arguments[3]);
    make(&first);
    make(&second);
    for (kind = 0; kind < sizeof bytes / sizeof *bytes; kind++) {
        forget_init(bytes[kind], 0);
        forget_init(bytes[kind], 1);
    }
    init_twice();
    interleave();
    interrupted(step_second, interrupts);
    compare(&first, "interrupted: other samples of the first,");
    compare(&second, "interrupted: other samples of the second,");
    interrupted(step_first, interrupts);
    begin(&first);
    interleave();
    printf("%ld interrupts in the middle of a step\n", 2 * interrupts);
    return 0;
}
