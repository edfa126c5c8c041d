/* @TITLE@, event-driven. See @NAME@_pieces.h. */
#include "@NAME@_pieces.h"

#include <float.h>
#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

@GUARD@
#define EPS DBL_EPSILON
#define N MODEL_PIECES_N
#define M MODEL_PIECES_M
#define CHOICES MODEL_PIECES_CHOICES
#define MOST_ORDERS MODEL_PIECES_ORDERS
#define COLUMNS MODEL_PIECES_COLUMNS
#define ROWS MODEL_PIECES_ROWS
#define KEPT MODEL_PIECES_KEPT
#define L N /* columns of l, y, t, and of h without l */
#define Y (N + M)
#define T @T@
#define H @H@
#if KNOWN
#define KNOWN_TIMES @KNOWN_TIMES@
#endif
#define UNUSED(a) (void)(a)
#ifdef __GNUC__
#define SELDOM __attribute__((cold, noinline)) /* built for its size, */
#define NOT_INLINE __attribute__((noinline)) /* or by itself: within others that takes long */
#else
#define SELDOM
#define NOT_INLINE
#endif
#define ROTATIONS 60 /* of all pairs of columns */
#define CLEAR_RATIO 1e6 /* of singular values: so far from SINGULAR that they need not be known */
#define DEPENDENT 1e-26 /* of its square: what is left of a row that depends on others */
#define FAR_FROM_SINGULAR (1e3*sqrt(SINGULAR))
#define EXPONENTS 3 /* p - 2, p - 1, p */
#define MOST_CODES 3 /* of a switch */
#define FNV_BASIS 14695981039346656037ULL /* Fowler, Noll, Vo: a hash */
#define FNV_PRIME 1099511628211ULL
#define WORK_OF_PIECE 1000000L /* of a piece */
@CONSTANTS@
