/* What a solver is. */

/* Whether the solver was initialised. */
static int is_ready(const model_solver *s) { return s->ready == READY; }

#if INPUTS
/* The inputs at the begin and at the end of a step stand behind all else that it starts from. */
#define BEGIN (MODEL_NSTATE - 2*MODEL_INPUTS)

static double *begin_of(model_solver *s) { return s->x + BEGIN; }

static double *end_of(model_solver *s) { return s->x + BEGIN + MODEL_INPUTS; }

#endif
