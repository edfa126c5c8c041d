/* Runs the model's own case and prints it as CSV: t, states@VELOCITIES@@MULTIPLIERS@. An argument N keeps every N-th row. */
#include "@NAME@.h"

#include <stdio.h>
#include <stdlib.h>

static void print_row(const model_solver *s, int with_multipliers)
{
    double x[MODEL_NX];
    model_get_state(s, x);
    printf("%.17g", model_get_time(s));
    for (int i = 0; i < MODEL_NX; i++)
        printf(",%.17g", x[i]);
#if VELOCITY
    double v[MODEL_NX];
    model_get_velocity(s, v);
    for (int i = 0; i < MODEL_NX; i++)
        printf(",%.17g", v[i]);
#endif
#if LAW
    double l[MODEL_NL];
    model_get_multipliers(s, l);
    for (int i = 0; i < MODEL_NL; i++)
        if (with_multipliers)
            printf(",%.17g", l[i]);
        else
            printf(",");
#else
    (void)with_multipliers;
#endif
    printf("\n");
}

int main(int argc, char **argv)
{
    static model_solver solver; /* memory of the caller: nothing is allocated */
#if MANY_STEPS
    static const double steps[] = {
@STEPS@
    };
#endif
    const long first = @FIRST@, last = @LAST@;
    const long every = argc > 1 ? strtol(argv[1], NULL, 10) : 1;
    double worst = 0;
    if (every < 1) {
        fprintf(stderr, "usage: %s [N], N >= 1: keep every N-th row\n", argv[0]);
        return 2;
    }
    if (model_init(&solver) != MODEL_OK) {
        fprintf(stderr, "no finite start\n");
        return 1;
    }
@COLUMNS@
    print_row(&solver, 0);
    for (long k = first; k < last; k++) {
#if MANY_STEPS
        model_set_step(&solver, steps[k]);
#endif
        const int status = model_step(&solver);
        if (status != MODEL_OK) {
            fprintf(stderr, "step %ld from t = %.10g: %s\n", k, model_get_time(&solver), model_status_text(status));
            return 1;
        }
        if (model_get_residual(&solver) > worst)
            worst = model_get_residual(&solver);
        if ((k + 1) % every == 0 || k + 1 == last)
            print_row(&solver, 1);
    }
    fprintf(stderr, "%ld steps, largest residual %.3g\n", last - first, worst);
    return 0;
}
