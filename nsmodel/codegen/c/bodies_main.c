/* Runs the model's own case and prints it as CSV: t, who is there, the states. An argument N keeps every N-th row. */
#include "@NAME@.h"

#include <stdio.h>
#include <stdlib.h>

static void print_row(const model_solver *s)
{
    int i, k, there = 0;
    for (i = 0; i < MODEL_BODIES; i++) there += s->present[i];
    printf("%.17g,%d", s->t, there);
    for (i = 0; i < MODEL_BODIES; i++)
        for (k = 0; k < MODEL_DIM; k++)
            if (s->present[i])
                printf(",%.17g", s->x[i*MODEL_DIM + k]);
            else
                printf(",nan");
    printf("\n");
}

int main(int argc, char **argv)
{
    static model_solver solver; /* memory of the caller: nothing is allocated */
    const long last = @LAST@;
    const long every = argc > 1 ? strtol(argv[1], NULL, 10) : 1;
    double worst = 0;
    long k;
    if (every < 1) {
        fprintf(stderr, "usage: %s [N], N >= 1: keep every N-th row\n", argv[0]);
        return 2;
    }
    model_init(&solver);
    printf("t,there");
    for (k = 0; k < MODEL_NX; k++) printf(",q_%ld", k);
    printf("\n");
    print_row(&solver);
    for (k = 0; k < last; k++) {
        const int status = model_step(&solver);
        if (status != MODEL_OK) {
            fprintf(stderr, "step %ld: %s\n", k, model_status_text(status));
            return 1;
        }
        if (solver.residual > worst) worst = solver.residual;
        if ((k + 1)%every == 0 || k + 1 == last) print_row(&solver);
    }
    fprintf(stderr, "%ld steps, worst residual %.2g\n", last, worst);
    return 0;
}
