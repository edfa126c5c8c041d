#if LAW
/* What a first step starts from: l = 0 moved into K, everything inactive that can be. */
static void first_multiplier(const model_solver *s, double *l, signed char *code)
{
    (void)s;
    for (int i = 0; i < MODEL_M; i++) {
        l[i] = min_of(max_of(0.0, LOWER[i]), UPPER[i]);
        code[i] = LOWER[i] == 0 ? -1 : 0;
    }
}

#endif
/* A unit of work: a linear system, an index set, a sweep. 0 where a step may do no more. */
static int spend(model_solver *s) { return s->spent < s->budget ? (s->spent++, 1) : 0; }

/* Whose answer a step is. */
@SOLVERS@
