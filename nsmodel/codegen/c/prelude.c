/* @TITLE@: one step of the scheme "@SCHEME@". See @NAME@.h. */
#include "@NAME@.h"

#include <float.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

@GUARD@
#define EPS DBL_EPSILON
#define TOLERANCE MODEL_TOLERANCE
@CONSTANTS@
#define EXPLAINED (TOLERANCE/ROUNDING) /* residuals up to this may be rounding alone: what passes for it with c = ROUNDING errs by u E */
#define ROUND_OFF (ROUNDING*EPS/2) /* part of its running error bound, which is in units of EPS/2, that a row may err by */

