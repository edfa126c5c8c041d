/* @TITLE@: one step of the scheme "@SCHEME@". See @NAME@.h. */
#include "@NAME@.h"

#include <float.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

@GUARD@
#define EPS DBL_EPSILON
#define TOLERANCE MODEL_TOLERANCE
#define UNRESOLVED 1e-280 /* scales below this are lost in denormal numbers */
#define NEGLIGIBLE 1e-6 /* part of the largest multiplier that another one need not resolve better */
#define GROWTH 1e3 /* how far the multipliers' terms may raise the scale of y above that of b */
#define EXPLAINED (TOLERANCE/8) /* residuals up to this may be rounding alone: what passes for it with c = 8 errs by u E */
#define CLEAR (1e-2*TOLERANCE) /* residuals up to this are told as they are; above, round-off may be excused */
#define ROUND_OFF (4*EPS) /* part of its running error bound, which is in units of EPS/2, that a row may err by: c = 8 */

