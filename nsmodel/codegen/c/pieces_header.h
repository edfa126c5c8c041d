/*
 * model_pieces: @TITLE@, event-driven: one smooth piece after another, each a Taylor polynomial in one mode.
 *
 * C99, libc and libm only. No allocation, no globals. A call does bounded work; what is not done then is told by its status, and
 * the next call goes on.
 */
#ifndef MODEL_PIECES_H
#define MODEL_PIECES_H

@STATUSES@

#ifdef __cplusplus
extern "C" {
#endif

#define MODEL_PIECES_N @N@ /* states */
#define MODEL_PIECES_M @M@ /* rows of the law */
#if INPUTS
#define MODEL_PIECES_NP @NP@ /* parameters, then inputs */
#define MODEL_PIECES_NU @NU@ /* inputs */
#else
#define MODEL_PIECES_NP @NP@ /* parameters */
#endif
#define MODEL_PIECES_DISCS @DISCS@ /* rows of the graphs, and what goes in and out */
#define MODEL_PIECES_CHOICES @CHOICES@ /* operations that are not analytic */
#if HELD
#define MODEL_PIECES_HELD @HELD@ /* states at the end that are set at known times */
#endif
#define MODEL_PIECES_ORDERS @ORDERS@ /* of series, at most */
#define MODEL_PIECES_COLUMNS @COLUMNS@
#define MODEL_PIECES_ROWS (MODEL_PIECES_N + 2*MODEL_PIECES_M)
#define MODEL_PIECES_KEPT @KEPT@
#define MODEL_PIECES_GERM @GERM@ /* coefficients that decide a germ */
#define MODEL_PIECES_TIMES @TIMES@
#define MODEL_PIECES_STIFF 4
#define MODEL_PIECES_UNDECIDED 5
#if STIFF
#define MODEL_PIECES_STAGES @STAGES@ /* of a piece by collocation, at most */
#define MODEL_PIECES_OCTAVES @OCTAVES@ /* of lengths whose matrices are kept */
#define MODEL_PIECES_UNKNOWN (MODEL_PIECES_N + MODEL_PIECES_M) /* at each */
#define MODEL_PIECES_SIDES (MODEL_PIECES_ROWS + MODEL_PIECES_CHOICES) /* x, l, y and what branches look at */
#endif
#if GUESSED
#define MODEL_PIECES_LEMKE @LEMKE@ /* rows of the law, with those that a linear complementarity problem adds */
#endif
#define MODEL_PIECES_VERDICTS 3
#define MODEL_PIECES_RECORD (6 + 4*MODEL_PIECES_M + MODEL_PIECES_N + (MODEL_PIECES_ORDERS + 1)*MODEL_PIECES_ROWS)

@STRUCT@
int model_pieces_init(model_pieces *s, double rtol); /* first: the start of the model; the error allowed, 1e-14 or more */
int model_pieces_set_state(model_pieces *s, double t, const double *x); /* begin anew at x[MODEL_PIECES_N] */
#if OWN_PARAMETERS
int model_pieces_set_parameters(model_pieces *s, const double *p); /* p[@NOWN@]; the state stays, its mode is chosen anew */
int model_pieces_reset(model_pieces *s); /* begin anew at the start of the model, at t = 0, as the parameters say */
#endif
#if INPUTS
int model_pieces_set_inputs(model_pieces *s, const double *u); /* u[MODEL_PIECES_NU], held from the time reached on; the mode is chosen anew */
#endif
void model_pieces_set_most(model_pieces *s, long pieces); /* in a call of model_advance, at most */

int model_advance(model_pieces *s, double t_end); /* integrate to t_end, which is not before the last time */
int model_advance_through(model_pieces *s, long count, const double *times, double *x); /* ... through times: states x[count*MODEL_PIECES_N] */

/* At the time reached. */
double model_pieces_get_time(const model_pieces *s);
void model_pieces_get_state(const model_pieces *s, double *x); /* x[MODEL_PIECES_N] */
#if INPUTS
void model_pieces_get_inputs(const model_pieces *s, double *u); /* u[MODEL_PIECES_NU] */
#endif
#if LAW
void model_pieces_get_multipliers(const model_pieces *s, double *l); /* l[MODEL_PIECES_M], row by row of the law */
void model_pieces_get_outputs(const model_pieces *s, double *y); /* y[MODEL_PIECES_M] */
void model_pieces_get_index_set(const model_pieces *s, signed char *index); /* 0: y = 0; -1, 1: l at its lower, upper end */
#endif
long model_pieces_get_events(const model_pieces *s); /* since the state was set */

#ifdef __cplusplus
}
#endif

#endif
