/* What runs before main() on a Cortex-M4: the table of vectors, the floating-point unit, a counter; output by semihosting. */
#include <stdint.h>

#define CONTROL ((volatile uint32_t *)0xE000E010u) /* SysTick: control, reload, value */
#define COPROCESSORS ((volatile uint32_t *)0xE000ED88u)
#define LONGEST 0xFFFFFFu

extern uint32_t __bss_start__, __bss_end__, __stack;
int main(void);

static void semihosting(int operation, const void *argument)
{
    register int r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
}

void print_text(const char *text) { semihosting(0x04, text); }

/* Ticks of the processor's clock, modulo 2^24. */
uint32_t count_ticks(void) { return LONGEST - CONTROL[2]; }

static void stop(void)
{
    semihosting(0x18, (void *)0x20026);
    for (;;)
        ;
}

static void reset(void)
{
    *COPROCESSORS |= 0xF00000u;
    for (uint32_t *p = &__bss_start__; p < &__bss_end__; p++)
        *p = 0;
    CONTROL[1] = LONGEST;
    CONTROL[2] = 0;
    CONTROL[0] = 5;
    main();
    stop();
}

static void fault(void)
{
    print_text("fault\n");
    stop();
}

__attribute__((section(".vectors"), used)) static void (*const vectors[16])(void) = {
    (void (*)(void))&__stack, reset, fault, fault, fault, fault, fault, 0, 0, 0, 0, fault, fault, 0, fault, fault};
