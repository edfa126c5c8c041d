/* fmax and fmin as in C99: they pass over a NaN. */
static double max_of(double a, double b) { return a > b || b != b ? a : b; }

static double min_of(double a, double b) { return a < b || b != b ? a : b; }

/* The larger, or NaN where one of them is: what is judged forgets nothing. */
static double worse_of(double a, double b) { return a > b || a != a ? a : b; }

static double sign_of(double a) { return a < 0 ? -1.0 : a > 0 ? 1.0 : a; }

static int is_finite(double a) { return a - a == 0; }
