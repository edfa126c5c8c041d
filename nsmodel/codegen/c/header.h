/*
 * model_solver: @TITLE@
 *
 * Scheme: @SCHEME@.
 * Every step is certified: its residual, computed from the law itself, is at most MODEL_TOLERANCE, or the step returns an error
 * and leaves the state as it was.
 *
 * C99, libc and libm only. No allocation but in model_create(), no globals: any number of solvers, each used by one thread at a
 * time. A solver must be initialised before anything else: memory of zeros is refused, pointers are not checked.
@NAMES@
 */
#ifndef MODEL_H
#define MODEL_H

#ifdef __cplusplus
extern "C" {
#endif

#define MODEL_NX @NX@ /* states */
#define MODEL_NSTATE @NSTATE@ /* what a step carries on: the states@CARRIED@ */
#define MODEL_NP @NP@ /* parameters */
#if GIVEN
#define MODEL_NU @NU@ /* inputs */
#endif
#if BLOCKS
#define MODEL_NZ @NZ@ /* memory of blocks */
#define MODEL_NW @NW@ /* what they hold: outputs, duties in force */
#endif
#define MODEL_NL @NL@ /* multipliers */
#define MODEL_N @N@ /* unknowns of a step */
#define MODEL_M @M@ /* rows of its law */
#define MODEL_STEP @STEP@ /* time step@UNIT_T@ */
#define MODEL_TOLERANCE @TOLERANCE@ /* largest residual of an accepted step, without unit */
#define MODEL_MAX_WORK @BOUND@ /* of a step: linear systems solved, index sets tried and sweeps, at most */
#define MODEL_MODEL_HASH "@HASH@" /* of the model with its numbers and its grid */
@SIZES@
/* What the functions return. */
@STATUSES@

typedef struct model_solver {
    /* To read; write with the functions below. */
    double t, h; /* time of the state, time step */
    double x[MODEL_NSTATE]; /* states@CARRIED@ */
#if PARAMETERS
    double p[MODEL_NP]; /* parameters */
#endif
#if LAW
    double l[MODEL_M], y[MODEL_M]; /* multipliers and outputs of the last step, row by row of the law */
    signed char index[MODEL_M]; /* 0: y = 0; -1, 1: l at its lower, upper end */
#endif
#if REWRITTEN
    double multipliers[MODEL_NL], outputs[MODEL_NL]; /* as the model declares them */
#endif
    /* Of the last step, whether it was taken or not: */
    double residual; /* of its answer, or of the last one tried; infinite where there was none */
    long spent; /* work: see MODEL_MAX_WORK */
    int status, iterations; /* iterations: linearisations, or rounds of a projection */
    int solver; /* whose answer it is: see the enum in @NAME@.c */
    double t_0, steps; /* t = t_0 + steps h */
    long budget; /* most work of a step */
    unsigned long ready; /* whether the solver is initialised */
#if RESTARTED
    double regime[MODEL_INPUTS]; /* inputs that the reaction belongs to: where a step begins with others, it is found anew */
#endif
#if BLOCKS
    int ticked; /* whether the blocks that are due at t have acted */
#endif
#if TOLERANCE_OF_NUMBER
    double number; /* of the step, which picks its tolerance eps_k */
#endif
#if LAW_OF_PARAMETERS
    double lower[MODEL_M], upper[MODEL_M]; /* ends of the law */
#endif
#if CURVED_OF_PARAMETERS
    double curved_numbers[MODEL_NUMBERS];
#endif
    /* What a step works in. */
    struct {
        double z[MODEL_N], x_next[MODEL_NSTATE], residual;
        int solver, iterations;
#if LAW
        double l[MODEL_M], y[MODEL_M];
        signed char code[MODEL_M];
#endif
#if REWRITTEN
        double multipliers[MODEL_NL], outputs[MODEL_NL];
#endif
#if INCLUSION
        double predictor[MODEL_NX];
#endif
    } work;
@MEMBERS@} model_solver;

/* First: initialise memory of your own, or let model_create() allocate and initialise. MODEL_NO_MALLOC, defined when this header
   and @NAME@.c are compiled, leaves create and free out. */
#ifndef MODEL_NO_MALLOC
model_solver *model_create(void); /* NULL where there is no memory */
void model_free(model_solver *s);
#endif
int model_init(model_solver *s); /* the start, step and parameters of the model */

/* Before a step. What is refused changes nothing. */
int model_reset(model_solver *s); /* back to the start, as the parameters give it; step and parameters stay */
int model_set_time(model_solver *s, double t);
int model_set_step(model_solver *s, double h); /* @STEP_RULE@ */
#if VELOCITY
int model_set_state(model_solver *s, const double *x); /* x[MODEL_NX]: positions; the velocity stays */
int model_set_velocity(model_solver *s, const double *v); /* v[MODEL_NX] */
#else
int model_set_state(model_solver *s, const double *x); /* x[MODEL_NX] */
#endif
#if FORCE
#if PARAMETERS
/* r[MODEL_NX]: the reaction at the state, which a step with gamma < 1 starts from. That of the start belongs to the parameters of
   the model: after others are set, set the reaction too. */
int model_set_force(model_solver *s, const double *r);
#else
int model_set_force(model_solver *s, const double *r); /* r[MODEL_NX]: the reaction at the state, which a step with gamma < 1 starts from */
#endif
#endif
#if PARAMETERS
int model_set_parameters(model_solver *s, const double *p); /* p[MODEL_NP]; the state stays */
#endif
#if GIVEN
/* u[MODEL_NU]: the inputs from the time of the state on, until they are set again. */
int model_set_inputs(model_solver *s, const double *u);
/* The inputs u(t+) and u((t + h)-) of the next step, at its begin and at its end; those after it have those of its end. */
int model_set_inputs_between(model_solver *s, const double *begin, const double *end);
#endif
int model_set_budget(model_solver *s, long work); /* most work of a step, beyond which it is MODEL_NOT_SOLVED; at first MODEL_MAX_WORK */

#if BLOCKS
/* Blocks act at the time of the state, before the step from there: once, in model_step() or, to read before it what they hold,
   here. MODEL_OWN_TICKS, defined when @NAME@.c is compiled, leaves it to the caller to call this or to set what they keep. */
int model_sample(model_solver *s);
/* The first time after that of the state at which a block ticks or a pulse begins or ends, with the inputs that are set; infinite
   where there is none. A step over it is MODEL_BAD_STEP. */
double model_next_tick(const model_solver *s);
#if MEMORY
int model_set_memory(model_solver *s, const double *z); /* z[MODEL_NZ] */
void model_get_memory(const model_solver *s, double *z);
#endif
#if HELD
int model_set_held(model_solver *s, const double *w); /* w[MODEL_NW] */
void model_get_held(const model_solver *s, double *w);
#endif

#endif
int model_step(model_solver *s); /* from t to t + h */

#if LAW
/* After a step: multipliers, outputs and index set mean nothing before the first. */
#else
/* After a step. */
#endif
double model_get_time(const model_solver *s);
void model_get_state(const model_solver *s, double *x);
#if VELOCITY
void model_get_velocity(const model_solver *s, double *v); /* the last difference of positions over the step in use */
#endif
#if FORCE
void model_get_force(const model_solver *s, double *r); /* the reaction at the state */
#endif
#if GIVEN
void model_get_inputs(const model_solver *s, double *u); /* those that the next step begins with: after a step those of its end */
#endif
#if MULTIPLIERS
void model_get_multipliers(const model_solver *s, double *l); /* l[MODEL_NL] */
void model_get_outputs(const model_solver *s, double *y); /* y[MODEL_NL] */
#endif
#if LAW
void model_get_index_set(const model_solver *s, signed char *index); /* index[MODEL_M] */
#endif
/* Of the last step, of one that failed too. */
double model_get_residual(const model_solver *s); /* of its answer, or of the last one tried; infinite where there was none */
int model_get_iterations(const model_solver *s);
long model_get_work(const model_solver *s); /* linear systems solved, index sets tried and sweeps: up to MODEL_MAX_WORK */
int model_get_status(const model_solver *s); /* what the step returned */
const char *model_status_text(int status); /* in words, for any of the values above */

#ifdef __cplusplus
}
#endif

#endif
