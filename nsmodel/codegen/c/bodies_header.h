/*
 * model_solver: @TITLE@
 *
 * Scheme: @SCHEME@.
 * Every step is certified: its residual, computed from the law itself, is at most MODEL_TOLERANCE, or the step returns an error
 * and leaves the state as it was. All constraints that could act in a step take part in it: what bodies move is checked after it.
 *
 * C99, libc and libm only. No allocation but in model_create(), no globals: any number of solvers, each used by one thread at a
 * time. A solver must be initialised before anything else: memory of zeros is refused, pointers are not checked.
 *
 * States: @STATES@.
 * Families of constraints: @FAMILIES@.
 */
#ifndef MODEL_H
#define MODEL_H

#ifdef __cplusplus
extern "C" {
#endif

#define MODEL_BODIES @BODIES@
#define MODEL_DIM @DIM@ /* states of a body */
#define MODEL_NX @NX@ /* MODEL_BODIES*MODEL_DIM */
#define MODEL_STEP @STEP@ /* time step@UNIT_T@ */
#define MODEL_TOLERANCE @TOLERANCE@ /* largest residual of an accepted step, without unit */
#define MODEL_MAX_WORK @WORK@ /* of a step: linear systems factored or solved, at most */
#define MODEL_CONTACTS @CONTACTS@ /* room for constraints with a reaction */
#ifndef MODEL_MEMORY
#define MODEL_MEMORY @MEMORY@ /* bytes that a step works in */
#endif
#define MODEL_MODEL_HASH "@HASH@" /* of the model with its numbers and its grid */

/* What the functions return. */
@STATUSES@

typedef struct model_solver {
    /* To read; write with the functions below. */
    double t, h; /* time of the state, time step */
    double x[MODEL_NX]; /* states, body after body */
    unsigned char present[MODEL_BODIES]; /* whether a body is there */
    int contacts; /* constraints with a reaction in the last step: */
    int family[MODEL_CONTACTS], first[MODEL_CONTACTS]; /* the family, the body, */
    int second[MODEL_CONTACTS]; /* the other body or the item, -1: none, */
    double multiplier[MODEL_CONTACTS]; /* and the reaction times the step of then, */
    double length; /* which was this */
    double gap; /* least constraint among those near, after that step */
    /* Of the last step, whether it was taken or not: */
    double residual; /* of its answer; infinite where there was none */
    long spent; /* work: see MODEL_MAX_WORK */
    int status, iterations; /* iterations: numeric factorisations */
    double t_0, steps, motion; /* t = t_0 + steps h */
    long budget; /* most work of a step */
    unsigned long ready; /* whether the solver is initialised */
    /* What a step works in. */
    struct {
        double x_next[MODEL_NX];
        unsigned char leaves[MODEL_BODIES];
        double memory[(MODEL_MEMORY + sizeof(double) - 1)/sizeof(double)];
    } work;
} model_solver;

/* First: initialise memory of your own, or let model_create() allocate and initialise. MODEL_NO_MALLOC, defined when this header
   and @NAME@.c are compiled, leaves create and free out. */
#ifndef MODEL_NO_MALLOC
model_solver *model_create(void); /* NULL where there is no memory */
void model_free(model_solver *s);
#endif
int model_init(model_solver *s); /* the start, and step of the model */

/* Before a step. What is refused changes nothing. */
int model_reset(model_solver *s); /* back to the start; the step stays */
int model_set_time(model_solver *s, double t);
int model_set_step(model_solver *s, double h);
int model_set_state(model_solver *s, const double *x); /* x[MODEL_NX]: finite for bodies that are present */
int model_set_present(model_solver *s, int body, int present); /* let a body, 0 to MODEL_BODIES - 1, at its state, take part or not */

int model_step(model_solver *s); /* from t to t + h; bodies that leave after it are no longer present */

/* After a step. */
double model_get_time(const model_solver *s);
void model_get_state(const model_solver *s, double *x); /* x[MODEL_NX] */
void model_get_present(const model_solver *s, unsigned char *present); /* present[MODEL_BODIES] */
void model_get_pressure(const model_solver *s, double *pressure); /* pressure[MODEL_BODIES]: sum of the reactions on each body */
/* Of the last step, of one that failed too. */
double model_get_residual(const model_solver *s); /* of its answer; infinite where there was none */
int model_get_iterations(const model_solver *s); /* numeric factorisations */
long model_get_work(const model_solver *s); /* linear systems factored or solved: up to MODEL_MAX_WORK */
int model_get_status(const model_solver *s); /* what the step returned */
const char *model_status_text(int status);

#ifdef __cplusplus
}
#endif

#endif
