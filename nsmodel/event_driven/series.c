/* Recurrences of Taylor coefficients, as in series.py: order k of a row y from orders 0, ..., k of others; STRIDE apart. */

static double product(const double *a, const double *b, int k)
{
    double sum = a[0]*b[k*STRIDE];
    for (int j = 1; j <= k; j++)
        sum += a[j*STRIDE]*b[(k - j)*STRIDE];
    return sum;
}

static double square(const double *a, int k)
{
    double sum = 0;
    for (int j = 0; 2*j < k; j++)
        sum += a[j*STRIDE]*a[(k - j)*STRIDE];
    return k % 2 ? 2*sum : 2*sum + a[(k/2)*STRIDE]*a[(k/2)*STRIDE];
}

static double quotient(const double *y, const double *a, const double *b, int k)
{
    double sum = a[k*STRIDE];
    for (int j = 0; j < k; j++)
        sum -= y[j*STRIDE]*b[(k - j)*STRIDE];
    return sum/b[0];
}

static double root(const double *y, const double *a, int k)
{
    double sum = a[k*STRIDE];
    for (int j = 1; j < k; j++)
        sum -= y[j*STRIDE]*y[(k - j)*STRIDE];
    return sum == 0 && y[0] == 0 ? 0 : sum/(2*y[0]);
}

static double power(const double *y, const double *a, double p, int k)
{
    double sum = 0;
    int still = p > 0 && a[0] == 0;
    for (int j = 0; j < k; j++) {
        sum += (p*(k - j) - j)*a[(k - j)*STRIDE]*y[j*STRIDE];
        still = still && a[(k - j)*STRIDE] == 0;
    }
    return still ? 0 : sum/(k*a[0]);
}

static double along(const double *factor, const double *a, int k)
{
    double sum = 0;
    for (int j = 1; j <= k; j++)
        sum += j*a[j*STRIDE]*factor[(k - j)*STRIDE];
    if (sum != sum) { /* A factor that is 0 in doubles makes 0 of what overflows. */
        sum = 0;
        for (int j = 1; j <= k; j++)
            if (factor[(k - j)*STRIDE] != 0)
                sum += j*a[j*STRIDE]*factor[(k - j)*STRIDE];
    }
    return sum/k;
}

static double against(const double *y, const double *divisor, double sign, const double *a, int k)
{
    double sum = 0;
    for (int j = 1; j < k; j++)
        sum += j*y[j*STRIDE]*divisor[(k - j)*STRIDE];
    sum = sign*a[k*STRIDE] - sum/k;
    return sum == 0 && divisor[0] == 0 ? 0 : sum/divisor[0];
}

static double angle(const double *y, const double *a, const double *b, const double *size, int k)
{
    double sum = 0;
    for (int j = 1; j <= k; j++)
        sum += j*(a[j*STRIDE]*b[(k - j)*STRIDE] - b[j*STRIDE]*a[(k - j)*STRIDE]);
    for (int j = 1; j < k; j++)
        sum -= j*y[j*STRIDE]*size[(k - j)*STRIDE];
    return sum/k/size[0];
}
