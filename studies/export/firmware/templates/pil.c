/* Processor in the loop: the controller on input that a host sends by semihosting.
 *
 * It reads commands from the file `to_target` and answers in `from_target`, both in the folder in
 * which the emulator runs. A command is two words, what to do and how many samples, then their
 * input:
 *
 *   0  sizes: channels; bytes of a wire, of a reference, of both states, of the stack
 *   1  {{ name }}_init
 *   2  {{ name }}_step for each row of sensors; answer: all rows of actuators, then all faults,
 *      then the time that each call took [ticks], then the depth of the stack [bytes]
 *   3  {{ name }}_shape_init with a reference
 *   4  {{ name }}_shape_step for each reference; answer: all shaped ones
 *   5  end
 *
 * Time is that of SysTick, which the emulator advances by a fixed number of ticks per instruction.
 */
#include "{{ name }}.h"

#define MOST {{ block }} /* samples of a command */
#define PAINT 0xA5C3A5C3u

typedef {{ wire }} wire;
typedef {{ word }} word;

extern uint32_t stack_bottom, stack_top;
void fault_handler(void);

static {{ name }}_state state;
static {{ name }}_shaper shaper;
static wire sensor[MOST][{{ NAME }}_N_CHANNELS], actuator[MOST][{{ NAME }}_N_CHANNELS];
static word reference[MOST][{{ NAME }}_N_POSE], shaped[MOST][{{ NAME }}_N_POSE];
static int32_t fault[MOST];
static uint32_t ticks[MOST];

/* --- the host --------------------------------------------------------------------------------- */

static int host(int operation, const void *argument)
{
    register int r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;

    __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

static void end(int is_good)
{
    const uint32_t reason = is_good ? 0x20026u : 0x20023u; /* exit of an application, or an error */

    for (;;) {
        (void)host(0x18, (const void *)(uintptr_t)reason);
    }
}

void fault_handler(void)
{
    end(0);
}

static int opened(const char *file, int length, int mode)
{
    const uint32_t block[3] = {(uint32_t)(uintptr_t)file, (uint32_t)mode, (uint32_t)length};
    const int handle = host(0x01, block);

    if (handle < 0) {
        end(0);
    }
    return handle;
}

/* All bytes, by SYS_READ (6) or SYS_WRITE (5), which say how many are left. */
static void transfer(int operation, int handle, void *data, uint32_t bytes)
{
    char *at = (char *)data;

    while (bytes > 0) {
        const uint32_t block[3] = {(uint32_t)handle, (uint32_t)(uintptr_t)at, bytes};
        const uint32_t left = (uint32_t)host(operation, block);

        if (left >= bytes) {
            end(operation == 6);
        }
        at += bytes - left;
        bytes = left;
    }
}

/* --- measuring -------------------------------------------------------------------------------- */

#define SYSTICK_CONTROL (*(volatile uint32_t *)0xE000E010u)
#define SYSTICK_RELOAD (*(volatile uint32_t *)0xE000E014u)
#define SYSTICK_VALUE (*(volatile uint32_t *)0xE000E018u)

typedef int (*step)({{ name }}_state *, const wire *, wire *);

#define UNUSED __attribute__((unused))

/* A call with one instruction in it. */
__attribute__((naked)) static int nothing(
    {{ name }}_state *at UNUSED, const wire *in UNUSED, wire *out UNUSED)
{
    __asm__ volatile("bx lr");
}

/* Time of a call [ticks]. */
__attribute__((noinline)) static uint32_t timed(step call, int sample)
{
    const uint32_t before = SYSTICK_VALUE;

    fault[sample] = call(&state, sensor[sample], actuator[sample]);
    return (before - SYSTICK_VALUE) & 0xFFFFFFu;
}

/* All samples; the depth of the stack that they need, with the call itself [bytes]. */
static uint32_t run(uint32_t count)
{
    volatile uint32_t *here, *at; /* volatile: no call of a library paints its own frame */
    uint32_t k, empty;

    __asm__ volatile("mov %0, sp" : "=r"(here));
    for (at = &stack_bottom; at < here; at++) {
        *at = PAINT;
    }
    empty = timed(nothing, 0);
    for (k = 0; k < count; k++) {
        ticks[k] = timed({{ name }}_step, (int)k) - empty;
    }
    for (at = &stack_bottom; at < here && *at == PAINT; at++) {
    }
    return (uint32_t)(here - at) * 4u;
}

int main(void)
{
    const int in = opened("to_target", 9, 1), out = opened("from_target", 11, 5);
    uint32_t command[2], k, depth;

    SYSTICK_RELOAD = 0xFFFFFFu;
    SYSTICK_VALUE = 0;
    SYSTICK_CONTROL = 5; /* on, by the processor's clock, no interrupt */
    for (;;) {
        transfer(6, in, command, sizeof command);
        if (command[1] > MOST) {
            end(0);
        }
        switch (command[0]) {
        case 0: {
            uint32_t sizes[6] = {{ "{" }}{{ NAME }}_N_CHANNELS, sizeof(wire), sizeof(word), sizeof state, sizeof shaper, 0};

            sizes[5] = (uint32_t)(&stack_top - &stack_bottom) * 4u;
            transfer(5, out, sizes, sizeof sizes);
            break;
        }
        case 1:
            {{ name }}_init(&state);
            break;
        case 2:
            transfer(6, in, sensor, command[1] * sizeof sensor[0]);
            depth = run(command[1]);
            transfer(5, out, actuator, command[1] * sizeof actuator[0]);
            transfer(5, out, fault, command[1] * sizeof fault[0]);
            transfer(5, out, ticks, command[1] * sizeof ticks[0]);
            transfer(5, out, &depth, sizeof depth);
            break;
        case 3:
            transfer(6, in, reference, sizeof reference[0]);
            {{ name }}_shape_init(&shaper, reference[0]);
            break;
        case 4:
            transfer(6, in, reference, command[1] * sizeof reference[0]);
            for (k = 0; k < command[1]; k++) {
                {{ name }}_shape_step(&shaper, reference[k], shaped[k]);
            }
            transfer(5, out, shaped, command[1] * sizeof shaped[0]);
            break;
        default:
            end(command[0] == 5);
        }
    }
}
