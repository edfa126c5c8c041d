/* The recurrences where a is a_0, or a_0 + a_1 s. */
static double product_point(const double *a, const double *b, int k) { return a[0]*b[k*STRIDE]; }

static double product_line(const double *a, const double *b, int k) { return a[0]*b[k*STRIDE] + a[STRIDE]*b[(k - 1)*STRIDE]; }

static double along_line(const double *factor, const double *a, int k) { return a[STRIDE]*factor[(k - 1)*STRIDE]/k; }
