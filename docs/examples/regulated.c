// A buck converter whose sampled PI is a block of the model, regulated.py of docs/inputs.md: the loop is closed in C.
//
//     nsmodel codegen regulated.py
//     cc -std=c99 -O2 -I regulated-c -o regulated docs/examples/regulated.c regulated-c/regulated.c -lm
//     ./regulated
#include "regulated.h"

#include <math.h>
#include <stdio.h>

/* Go on to a time: no step goes over a tick, nor over an edge of the pulse; up to the next one, equal steps. */
static int run(regulated_solver *s, double t_end)
{
    int status = REGULATED_OK;
    for (double t = s->t, next; t < t_end && status == REGULATED_OK; t = next) {
        next = fmin(regulated_next_tick(s), t_end);
        const int steps = (int)fmax(ceil((next - t)/REGULATED_STEP - 1e-9), 1);
        status = regulated_set_step(s, (next - t)/steps);
        for (int i = 0; i < steps && status == REGULATED_OK; i++)
            status = regulated_step(s);
        if (status == REGULATED_OK)
            status = regulated_set_time(s, next); /* to rounding it is that already */
    }
    return status;
}

int main(void)
{
    static regulated_solver s;
    double x[REGULATED_NX], w[REGULATED_NW];
    int status = regulated_init(&s);
    if (status == REGULATED_OK)
        status = run(&s, 6e-3);
    if (status != REGULATED_OK) {
        fprintf(stderr, "t = %g: %s\n", s.t, regulated_status_text(status));
        return 1;
    }
    regulated_get_state(&s, x);
    regulated_get_held(&s, w);
    printf("t = %g s, v = %.4f V with a duty of %.4f\n", s.t, x[1], w[0]);
    return 0;
}
