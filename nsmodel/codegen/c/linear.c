/*
 * Linear systems: LU with partial pivoting, and the singular values where a matrix is singular to rounding.
 */

#define COPY(to, from, count) memcpy(to, from, (size_t)(count)*sizeof *(to))
#define ZERO(to, count) memset(to, 0, (size_t)(count)*sizeof *(to))
#define SVD_SWEEPS 60 /* Jacobi's method needs about 10 */
#define SCALE_SWEEPS 6 /* of Ruiz' iteration */
#define LEAST_EXPONENT (-1000) /* of the unit of a matrix: its squares are no denormal numbers */
#if INVERTED
#define PINV_CUT 1e-15 /* singular values below this part of the largest count as 0 in a pseudo-inverse */
#define AS_GIVEN 1e3 /* condition up to which a matrix is inverted in the user's units */
#endif

/* Factor A = P L U in place, row pivot[k] swapped with row k at step k. Return 0, or 1 where A is singular or not finite. */
static int lu_factor(int n, double *A, int *pivot)
{
    for (int k = 0; k < n; k++) {
        int p = k;
        for (int i = k + 1; i < n; i++)
            if (fabs(A[i*n + k]) > fabs(A[p*n + k]))
                p = i;
        if (A[p*n + k] == 0 || !is_finite(A[p*n + k]))
            return 1;
        pivot[k] = p;
        if (p != k)
            for (int j = 0; j < n; j++) {
                const double held = A[k*n + j];
                A[k*n + j] = A[p*n + j];
                A[p*n + j] = held;
            }
        for (int i = k + 1; i < n; i++) {
            const double factor = A[i*n + k] /= A[k*n + k];
            if (factor != 0)
                for (int j = k + 1; j < n; j++)
                    A[i*n + j] -= factor*A[k*n + j];
        }
    }
    return 0;
}

#if ENUMERATED
/* x - the sum of a_j b_j; exactly 0 where nothing but round-off is left: a multiplier that must be 0 shall be just that. */
static double less(double x, int n, const double *a, const double *b)
{
    double sum = x, size = fabs(x);
    for (int j = 0; j < n; j++) {
        sum -= a[j]*b[j];
        size += fabs(a[j]*b[j]);
    }
    return fabs(sum) <= SUM_ERROR*EPS*size ? 0 : sum;
}
#else
/* x - the sum of a_j b_j. */
static double less(double x, int n, const double *a, const double *b)
{
    for (int j = 0; j < n; j++)
        x -= a[j]*b[j];
    return x;
}
#endif

/* Solve A x = x_0 with the factors of A, x_0 in x. */
static void lu_solve(int n, const double *LU, const int *pivot, double *x)
{
    for (int k = 0; k < n; k++) {
        const double held = x[pivot[k]];
        x[pivot[k]] = x[k];
        x[k] = held;
    }
    for (int i = 1; i < n; i++)
        x[i] = less(x[i], i, LU + i*n, x);
    for (int i = n - 1; i >= 0; i--)
        x[i] = less(x[i], n - 1 - i, LU + i*n + i + 1, x + i + 1)/LU[i*n + i];
}

static int all_finite(int n, const double *x)
{
    for (int i = 0; i < n; i++)
        if (!is_finite(x[i]))
            return 0;
    return 1;
}

static double largest(int n, const double *x)
{
    double most = 0;
    for (int i = 0; i < n; i++)
        most = worse_of(most, fabs(x[i]));
    return most;
}

static double dot(int n, const double *x, const double *y)
{
    double sum = 0;
    for (int i = 0; i < n; i++)
        sum += x[i]*y[i];
    return sum;
}

/* Give the rows and columns of linear.lu units, powers of 2, that bring its entries near 1 (Ruiz' iteration): what is singular
   must not depend on the user's. Return the largest entry then. */
static double balance(model_solver *s, int n)
{
    double *A = s->linear.lu, *rows = s->linear.rows, *columns = s->linear.columns;
    for (int i = 0; i < n; i++)
        rows[i] = columns[i] = 1;
    for (int sweep = 0; sweep < SCALE_SWEEPS; sweep++) {
        for (int i = 0; i < n; i++) {
            int exponent = 0;
            frexp(largest(n, A + i*n), &exponent);
            const double unit = ldexp(1, -exponent/2);
            rows[i] *= unit;
            for (int j = 0; j < n; j++)
                A[i*n + j] *= unit;
        }
        for (int j = 0; j < n; j++) {
            double most = 0;
            int exponent = 0;
            for (int i = 0; i < n; i++)
                most = max_of(most, fabs(A[i*n + j]));
            frexp(most, &exponent);
            const double unit = ldexp(1, -exponent/2);
            columns[j] *= unit;
            for (int i = 0; i < n; i++)
                A[i*n + j] *= unit;
        }
    }
    return largest(n*n, A);
}

static void rotate(int n, double c, double s, double *x, double *y)
{
    for (int i = 0; i < n; i++) {
        const double held = x[i];
        x[i] = c*held - s*y[i];
        y[i] = s*held + c*y[i];
    }
}

/* The SVD A = U S V' of the matrix in linear.lu by one-sided Jacobi rotations: the rows of linear.lu become the columns of U S,
   the rows of linear.v those of V, and linear.x holds the squares of the singular values, the largest of which is returned.
   A is first divided by a power of 2, *unit, so that squares neither overflow nor vanish. */
static double decompose(model_solver *s, int n, double *unit)
{
    double *G = s->linear.lu, *V = s->linear.v, most = 0;
    int exponent, rotated = 1;
    frexp(largest(n*n, G), &exponent);
    *unit = ldexp(1, exponent > LEAST_EXPONENT ? exponent - 1 : LEAST_EXPONENT);
    for (int i = 0; i < n; i++)
        for (int j = 0; j <= i; j++) {
            const double held = G[i*n + j];
            G[i*n + j] = G[j*n + i] / *unit;
            G[j*n + i] = held / *unit;
            V[i*n + j] = V[j*n + i] = i == j;
        }
    for (int sweep = 0; sweep < SVD_SWEEPS && rotated; sweep++) {
        rotated = 0;
        for (int p = 0; p < n; p++)
            for (int q = p + 1; q < n; q++) {
                double *x = G + p*n, *y = G + q*n;
                const double alpha = dot(n, x, x), beta = dot(n, y, y), gamma = dot(n, x, y);
                if (!(fabs(gamma) > n*EPS*sqrt(alpha)*sqrt(beta)))
                    continue;
                const double zeta = (beta - alpha)/(2*gamma);
                const double t = (zeta < 0 ? -1 : 1)/(fabs(zeta) + sqrt(1 + zeta*zeta));
                const double c = 1/sqrt(1 + t*t);
                rotate(n, c, c*t, x, y);
                rotate(n, c, c*t, V + p*n, V + q*n);
                rotated = 1;
            }
    }
    for (int j = 0; j < n; j++) {
        s->linear.x[j] = dot(n, G + j*n, G + j*n);
        most = worse_of(most, s->linear.x[j]);
    }
    return most;
}

/* Minimise |A x - x_0|, and of all such x take the least: A in linear.lu, x_0 in x. Singular values up to the part ``cut`` of the
   largest count as 0. Return 0, or 1 where x is not finite. */
static int least_squares(model_solver *s, int n, double cut, double *x)
{
    if (!all_finite(n*n, s->linear.lu))
        return 1;
    double unit;
    const double most = decompose(s, n, &unit);
    COPY(s->linear.rhs, x, n);
    ZERO(x, n);
    for (int j = 0; j < n; j++)
        if (s->linear.x[j] > cut*cut*most) {
            const double part = dot(n, s->linear.lu + j*n, s->linear.rhs)/s->linear.x[j]/unit;
            for (int i = 0; i < n; i++)
                x[i] += part*s->linear.v[j*n + i];
        }
    return !all_finite(n, x);
}

/* Solve A x = x_0 with the factors in linear.lu, x_0 in x, with one refinement by A, whose entry (i, j) is rows_i A_ij columns_j.
   Return 0, or 1 where A seems singular. */
static int solved(model_solver *s, int n, const double *A, double *x)
{
    double *rhs = s->linear.rhs, *more = s->linear.x, size = 0;
    const double *rows = s->linear.rows, *columns = s->linear.columns;
    lu_solve(n, s->linear.lu, s->linear.pivot, x);
    for (int i = 0; i < n; i++) {
        more[i] = rhs[i];
        for (int j = 0; j < n; j++)
            more[i] -= rows[i]*A[i*n + j]*columns[j]*x[j];
    }
    lu_solve(n, s->linear.lu, s->linear.pivot, more);
    for (int i = 0; i < n; i++)
        x[i] += more[i];
    for (int i = 0; i < n; i++) {
        double terms = 0;
        for (int j = 0; j < n; j++)
            terms += fabs(rows[i]*A[i*n + j]*columns[j]*x[j]);
        size = worse_of(size, terms);
    }
    return !all_finite(n, x) || !(size <= CANCELLED*largest(n, rhs));
}

/* Solve A x = x_0, x_0 in x, with one refinement; the least-squares solution of least norm where A is singular, also in units in
   which it is well scaled. Return 0, or 1 where x is not finite, or there is no more work to spend. */
static int solve_or_least_squares(model_solver *s, int n, const double *A, double *x)
{
    double *start = s->linear.start, *rhs = s->linear.rhs;
    if (!spend(s))
        return 1;
    COPY(start, x, n);
    COPY(s->linear.lu, A, n*n);
    for (int scaled = 0; scaled < 2; scaled++) {
        for (int i = 0; i < n; i++)
            s->linear.rows[i] = s->linear.columns[i] = 1;
        if (scaled) {
            COPY(s->linear.lu, A, n*n);
            balance(s, n);
        }
        for (int i = 0; i < n; i++)
            x[i] = rhs[i] = s->linear.rows[i]*start[i];
        if (!lu_factor(n, s->linear.lu, s->linear.pivot) && !solved(s, n, A, x)) {
            for (int i = 0; i < n; i++)
                x[i] *= s->linear.columns[i];
            return 0;
        }
    }
    COPY(s->linear.lu, A, n*n);
    COPY(x, start, n);
    return least_squares(s, n, n*EPS, x);
}
#if INVERSE

/* The inverse of the matrix whose factors are in linear.lu. */
static void lu_inverse(model_solver *s, int n, double *inverse)
{
    double *x = s->linear.x;
    for (int j = 0; j < n; j++) {
        for (int i = 0; i < n; i++)
            x[i] = i == j;
        lu_solve(n, s->linear.lu, s->linear.pivot, x);
        for (int i = 0; i < n; i++)
            inverse[i*n + j] = x[i];
    }
}
#endif
#if INVERTED

#if REGULAR_SETS
/* The inverse of A. Return 0, or 1 where A is singular to rounding: an index set with a regular matrix solves the problem too. */
#else
/* The inverse of A: 0; its pseudo-inverse where A is singular to rounding: -1; or 1 where that is not finite. */
#endif
static int invert(model_solver *s, int n, const double *A, double *inverse)
{
    const double *rows = s->linear.rows, *columns = s->linear.columns;
    int regular = 0;
    if (!all_finite(n*n, A))
        return 1;
    for (int balanced = 0; balanced <= 1 && !regular; balanced++) { /* where the user's units do, no others are looked for */
        COPY(s->linear.lu, A, n*n);
        const double size = balanced ? balance(s, n) : largest(n*n, A);
        if (lu_factor(n, s->linear.lu, s->linear.pivot))
            continue;
        lu_inverse(s, n, inverse);
        regular = all_finite(n*n, inverse) && largest(n*n, inverse)*size <= (balanced ? ILL_CONDITIONED : AS_GIVEN);
        if (regular && !balanced)
            return 0;
    }
#if REGULAR_SETS
    if (!regular)
        return 1;
#else
    if (!regular) {
        COPY(s->linear.lu, A, n*n);
        for (int i = 0; i < n; i++)
            s->linear.rows[i] = s->linear.columns[i] = 1;
        double unit;
        const double most = decompose(s, n, &unit);
        ZERO(inverse, n*n);
        for (int k = 0; k < n; k++)
            if (s->linear.x[k] > PINV_CUT*PINV_CUT*most)
                for (int i = 0; i < n; i++)
                    for (int j = 0; j < n; j++)
                        inverse[i*n + j] += s->linear.v[k*n + i]*(s->linear.lu[k*n + j]/s->linear.x[k]/unit);
    }
#endif
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            inverse[i*n + j] *= columns[i]*rows[j];
    return !all_finite(n*n, inverse) ? 1 : regular ? 0 : -1;
}
#endif
