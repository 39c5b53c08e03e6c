/* Vector table and reset of an Arm Cortex-M, see board.ld.
 *
 * The stack lies at the bottom of the RAM: one that is too small ends in a fault, at once, and not
 * in overwritten data.
 */
#include <stdint.h>

extern uint32_t stack_top, data_load, data_begin, data_end, bss_begin, bss_end;

int main(void);
void reset(void);

/* What has no handler of its own stops here. */
void unexpected(void);
void unexpected(void)
{
    for (;;) {
    }
}

void fault_handler(void) __attribute__((weak, alias("unexpected")));
void timer_handler(void) __attribute__((weak, alias("unexpected")));

void reset(void)
{
    const uint32_t *from = &data_load;
    uint32_t *to;

#if defined(__ARM_FP)
    /* coprocessors 10 and 11, the floating-point unit, in CPACR */
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20;
    __asm__ volatile("dsb\n\tisb" : : : "memory");
#endif
    for (to = &data_begin; to < &data_end; to++) {
        *to = *from++;
    }
    for (to = &bss_begin; to < &bss_end; to++) {
        *to = 0;
    }
    (void)main();
    unexpected();
}

typedef void (*handler)(void);

/* The first word is the stack pointer, the second one reset, 3 to 6 faults, 15 the SysTick timer. */
__attribute__((section(".vectors"), used)) static const handler VECTORS[16] = {
    (handler)(uintptr_t)&stack_top,
    reset,
    unexpected,
    fault_handler,
    fault_handler,
    fault_handler,
    fault_handler,
    unexpected,
    unexpected,
    unexpected,
    unexpected,
    unexpected,
    unexpected,
    unexpected,
    unexpected,
    timer_handler,
};
