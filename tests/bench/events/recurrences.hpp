// Order k of a Taylor series from orders 0 ... k of its arguments (TIDES, heyoka); rows are arrays of coefficients.
#include <cmath>

static inline double product(const double *a, const double *b, int k)
{
    double s = a[0]*b[k];
    for (int j = 1; j <= k; j++)
        s += a[j]*b[k - j];
    return s;
}

static inline double square(const double *a, int k)
{
    if (k == 0)
        return a[0]*a[0];
    double s = a[0]*a[k];
    for (int j = 1; 2*j < k; j++)
        s += a[j]*a[k - j];
    s += s;
    return k % 2 ? s : s + a[k/2]*a[k/2];
}

static inline double quotient(double a_k, const double *b, const double *y, int k)
{
    for (int j = 0; j < k; j++)
        a_k -= y[j]*b[k - j];
    return a_k/b[0];
}

static inline double root(const double *a, const double *y, int k)
{
    if (k == 0)
        return std::sqrt(a[0]);
    double s = a[k];
    for (int j = 1; j < k; j++)
        s -= y[j]*y[k - j];
    return s/(2*y[0]);
}

static inline double exponential(const double *a, const double *y, int k)
{
    if (k == 0)
        return std::exp(a[0]);
    double s = 0;
    for (int j = 1; j <= k; j++)
        s += j*a[j]*y[k - j];
    return s/k;
}

static inline void sine_cosine(const double *a, double *s, double *c, int k)
{
    if (k == 0) {
        s[0] = std::sin(a[0]);
        c[0] = std::cos(a[0]);
        return;
    }
    double u = 0, v = 0;
    for (int j = 1; j <= k; j++) {
        u += j*a[j]*c[k - j];
        v -= j*a[j]*s[k - j];
    }
    s[k] = u/k;
    c[k] = v/k;
}

// The same of an argument that is linear in time.
static inline void sine_cosine_of_line(const double *a, double *s, double *c, int k)
{
    if (k == 0)
        return sine_cosine(a, s, c, 0);
    s[k] = a[1]*c[k - 1]/k;
    c[k] = -a[1]*s[k - 1]/k;
}

static inline double larger(double a, double b) { return b > a ? b : a; }
static inline double smaller(double a, double b) { return b < a ? b : a; }
