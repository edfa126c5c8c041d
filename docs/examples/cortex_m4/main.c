/* Takes STEPS steps of the library NAME (gcc -DNAME=... -DSTEPS=... -include NAME.h) and prints: the status, the steps taken, ticks of
   all and of the longest, and the bits of the state. */
#include <stdint.h>
#include <string.h>

#define JOINED(a, b) a##b
#define CALL(name, function) JOINED(name, function)
#define OF(function) CALL(NAME, function)

void print_text(const char *text);
uint32_t count_ticks(void);

static OF(_solver) solver;
static double x[sizeof solver/sizeof(double)];

static void print_number(uint64_t number, unsigned base)
{
    char text[24];
    int at = sizeof text - 1;
    text[at] = 0;
    text[--at] = ' ';
    do
        text[--at] = "0123456789abcdef"[number % base];
    while (number /= base);
    print_text(text + at);
}

int main(void)
{
    int status = OF(_init)(&solver);
    uint64_t all = 0, longest = 0, taken = 0;
    for (; taken < STEPS && status == 0; taken++) {
        const uint32_t begin = count_ticks();
        status = OF(_step)(&solver);
        const uint64_t ticks = (count_ticks() - begin) & 0xFFFFFFu;
        all += ticks;
        longest = ticks > longest ? ticks : longest;
    }
    print_number(status, 10);
    print_number(taken, 10);
    print_number(all, 10);
    print_number(longest, 10);
    OF(_get_state)(&solver, x);
    for (int i = 0; i < STATES; i++) {
        uint64_t bits;
        memcpy(&bits, x + i, sizeof bits);
        print_number(bits, 16);
    }
    print_text("\n");
    return 0;
}
