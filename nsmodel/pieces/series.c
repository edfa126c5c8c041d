/* Recurrences of Taylor coefficients, as in series.py: order k of a row y from orders 0, ..., k of others. */

static double product(const double *a, const double *b, int k)
{
    double sum = a[0]*b[k];
    for (int j = 1; j <= k; j++)
        sum += a[j]*b[k - j];
    return sum;
}

static double square(const double *a, int k)
{
    double sum = 0;
    for (int j = 0; 2*j < k; j++)
        sum += a[j]*a[k - j];
    return k % 2 ? 2*sum : 2*sum + a[k/2]*a[k/2];
}

static double quotient(const double *y, const double *a, const double *b, int k)
{
    double sum = a[k];
    for (int j = 0; j < k; j++)
        sum -= y[j]*b[k - j];
    return sum/b[0];
}

static double root(const double *y, const double *a, int k)
{
    double sum = a[k];
    for (int j = 1; j < k; j++)
        sum -= y[j]*y[k - j];
    return sum/(2*y[0]);
}

static double power(const double *y, const double *a, double p, int k)
{
    double sum = 0;
    for (int j = 0; j < k; j++)
        sum += (p*(k - j) - j)*a[k - j]*y[j];
    return sum/(k*a[0]);
}

static double along(const double *factor, const double *a, int k)
{
    double sum = 0;
    for (int j = 1; j <= k; j++)
        sum += j*a[j]*factor[k - j];
    return sum/k;
}

static double against(const double *y, const double *divisor, double sign, const double *a, int k)
{
    double sum = 0;
    for (int j = 1; j < k; j++)
        sum += j*y[j]*divisor[k - j];
    return (sign*a[k] - sum/k)/divisor[0];
}

static double angle(const double *y, const double *a, const double *b, const double *size, int k)
{
    double sum = 0;
    for (int j = 1; j <= k; j++)
        sum += j*(a[j]*b[k - j] - b[j]*a[k - j]);
    for (int j = 1; j < k; j++)
        sum -= j*y[j]*size[k - j];
    return sum/k/size[0];
}
