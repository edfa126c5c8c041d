/* Runs the model's own case and prints it as CSV: t, states@VELOCITIES@@MULTIPLIERS@. An argument N keeps every N-th row. */
#include "@NAME@.h"

#if PULSES
#include <math.h>
#endif
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

#if STRETCHES
#if PULSES
/* Between two edges of the caller's inputs, which go from begin to end in straight lines. */
static const struct stretch {
#if GIVEN
    double t, t_end, begin[MODEL_NU], end[MODEL_NU];
#else
    double t, t_end;
#endif
} stretches[] = {
@STRETCHES@
};

#if GIVEN
static void inputs_at(const struct stretch *at, double t, double *u)
{
    for (int i = 0; i < MODEL_NU; i++)
        u[i] = at->begin[i] + (at->end[i] - at->begin[i])*((t - at->t)/(at->t_end - at->t));
}

#endif
#else
/* Steps of one length, between two edges of the inputs: these go from begin to end in straight lines. */
static const struct {
    double t;
    int steps;
#if GIVEN
    double h, begin[MODEL_NU], end[MODEL_NU];
#else
    double h;
#endif
} stretches[] = {
@STRETCHES@
};

#endif
#endif
#if PULSES
static const long first = @FIRST@;
#else
static const long first = @FIRST@, last = @LAST@;
#endif
static double worst;

/* Take step k, and print it where it is to be kept; the status. */
static int advanced(model_solver *s, long k, long every, int is_last)
{
    const int status = model_step(s);
    if (status != MODEL_OK) {
        fprintf(stderr, "step %ld from t = %.10g: %s\n", k, model_get_time(s), model_status_text(status));
        return status;
    }
    if (model_get_residual(s) > worst)
        worst = model_get_residual(s);
    if ((k + 1) % every == 0 || is_last)
        print_row(s, 1);
    return status;
}

int main(int argc, char **argv)
{
    static model_solver solver; /* memory of the caller: nothing is allocated */
#if MANY_STEPS
    static const double steps[] = {
@STEPS@
    };
#endif
    const long every = argc > 1 ? strtol(argv[1], NULL, 10) : 1;
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
    long k = first;
#if STRETCHES
    const size_t count = sizeof stretches/sizeof *stretches;
    for (size_t i = 0; i < count; i++) {
#if PULSES
        /* No step goes over a tick, nor over an edge of a pulse: up to the next one equal steps, of the length that this asks for. */
        const struct stretch *at = &stretches[i];
        for (double t = model_get_time(&solver), next; t < at->t_end; t = next) {
#if GIVEN
            double begin[MODEL_NU], end[MODEL_NU];
            inputs_at(at, t, begin);
            model_set_inputs(&solver, begin);
#endif
            next = model_next_tick(&solver);
            next = next < at->t_end ? next : at->t_end;
            const int steps = (int)fmax(ceil((next - t)/MODEL_STEP*(1 - @WHOLE_STEPS@)), 1);
            const double h = (next - t)/steps;
            model_set_step(&solver, h);
            for (int j = 0; j < steps; j++, k++) {
#if GIVEN
                inputs_at(at, t + j*h, begin);
                inputs_at(at, t + (j + 1)*h, end);
                model_set_inputs_between(&solver, begin, end);
#endif
                if (advanced(&solver, k, every, i + 1 == count && next == at->t_end && j + 1 == steps) != MODEL_OK)
                    return 1;
            }
            model_set_time(&solver, next);
        }
#else
        model_set_time(&solver, stretches[i].t);
        model_set_step(&solver, stretches[i].h);
        for (int j = 0; j < stretches[i].steps; j++, k++) {
#if GIVEN
            double begin[MODEL_NU], end[MODEL_NU];
            for (int m = 0; m < MODEL_NU; m++) {
                const double u = stretches[i].begin[m], change = (stretches[i].end[m] - u)/stretches[i].steps;
                begin[m] = u + change*j;
                end[m] = u + change*(j + 1);
            }
            model_set_inputs_between(&solver, begin, end);
#endif
            if (advanced(&solver, k, every, k + 1 == last) != MODEL_OK)
                return 1;
        }
#endif
    }
#else
    for (; k < last; k++) {
#if MANY_STEPS
        model_set_step(&solver, steps[k]);
#endif
        if (advanced(&solver, k, every, k + 1 == last) != MODEL_OK)
            return 1;
    }
#endif
    fprintf(stderr, "%ld steps, largest residual %.3g\n", k - first, worst);
    return 0;
}
