// A converter in a control loop: once a period a sampled PI chooses the duty of a PWM; steps end at its edges.
//
//     nsmodel codegen buck.py --any-step
//     cc -std=c99 -O2 -I buck-c -o buck docs/examples/buck.c buck-c/buck.c -lm
//     ./buck
#include "buck.h"

#include <math.h>
#include <stdio.h>

#define PERIOD 10e-6
#define LONGEST (PERIOD/20) /* step */

/* Hold u for a time, in equal steps that are not longer than LONGEST. */
static int hold(buck_solver *s, double u, double time)
{
    const int steps = (int)ceil(time/LONGEST*(1 - 1e-9));
    int status = buck_set_inputs(s, &u);
    if (steps > 0)
        status = buck_set_step(s, time/steps);
    for (int i = 0; i < steps && status == BUCK_OK; i++)
        status = buck_step(s);
    return status;
}

int main(void)
{
    static buck_solver s;
    double x[BUCK_NX], z = 0;
    if (buck_init(&s) != BUCK_OK)
        return 1;
    for (int k = 0; k < 200; k++) {
        buck_set_time(&s, k*PERIOD); /* edges are products, not sums */
        buck_get_state(&s, x);
        const double e = 9 - x[1], duty = fmin(fmax(0.02*e + z, 0), 0.9);
        z += 0.002*e;
        if (hold(&s, 1, duty*PERIOD) != BUCK_OK || hold(&s, 0, (1 - duty)*PERIOD) != BUCK_OK) {
            fprintf(stderr, "t = %g: %s\n", s.t, buck_status_text(s.status));
            return 1;
        }
    }
    buck_get_state(&s, x);
    printf("t = %g s, i = %.9f A, v = %.9f V\n", s.t, x[0], x[1]);
    return 0;
}
