// The first root in (0, 1] of a polynomial: Bernstein coefficients, halved until they have one change of sign.
static const double NO_ROOT = 2, NARROW = 1e-13;

static double horner(const double *c, int n, double s)
{
    double v = c[n];
    for (int k = n - 1; k >= 0; k--)
        v = v*s + c[k];
    return v;
}

struct Bernstein {
    double ratio[PM + 1][PM + 1][PM + 1];  // [n][j][k] = C(j, k)/C(n, k)

    Bernstein()
    {
        static double c[PM + 1][PM + 1];
        for (int n = 0; n <= PM; n++) {
            c[n][0] = 1;
            for (int k = 1; k <= n; k++)
                c[n][k] = c[n - 1][k - 1] + (k < n ? c[n - 1][k] : 0);
        }
        for (int n = 0; n <= PM; n++)
            for (int j = 0; j <= n; j++)
                for (int k = 0; k <= j; k++)
                    ratio[n][j][k] = c[j][k]/c[n][k];
    }

    double first_root(const double *c, int n) const
    {
        double b[PM + 1];
        for (int j = 0; j <= n; j++) {
            b[j] = c[0];
            for (int k = 1; k <= j; k++)
                b[j] += ratio[n][j][k]*c[k];
        }
        return isolate(c, n, b, 0, 1);
    }

private:
    // c(lo) > 0 > c(hi): Newton's method, kept inside by halving.
    static double simple_root(const double *c, int n, double lo, double hi)
    {
        double s = (lo + hi)/2;
        for (int iteration = 0; iteration < 80; iteration++) {
            double v = c[n], d = 0;
            for (int k = n - 1; k >= 0; k--) {
                d = d*s + v;
                v = v*s + c[k];
            }
            if (v == 0)
                return s;
            (v > 0 ? lo : hi) = s;
            double next = d != 0 ? s - v/d : lo;
            if (!(next > lo && next < hi))
                next = (lo + hi)/2;
            if (fabs(next - s) <= 2e-16*hi)
                return next;
            s = next;
        }
        return s;
    }

    static double isolate(const double *c, int n, const double *b, double lo, double w)
    {
        if (b[0] <= 0 && lo > 0)
            return lo;
        int changes = 0, last = b[0] > 0 ? 1 : -1;
        for (int j = 1; j <= n; j++)
            if (b[j] != 0 && (b[j] > 0 ? 1 : -1) != last) {
                last = -last;
                changes++;
            }
        if (changes == 0)
            return b[n] == 0 ? lo + w : last > 0 ? NO_ROOT : lo;
        if (changes == 1 && b[0] > 0 && b[n] <= 0)
            return b[n] == 0 ? lo + w : simple_root(c, n, lo, lo + w);
        if (w < NARROW)
            return lo;
        double left[PM + 1], right[PM + 1];
        for (int j = 0; j <= n; j++)
            right[j] = b[j];
        for (int j = 0; j <= n; j++) {
            left[j] = right[0];
            for (int k = 0; k < n - j; k++)
                right[k] = (right[k] + right[k + 1])*0.5;
        }
        const double s = isolate(c, n, left, lo, w/2);
        return s <= 1 ? s : isolate(c, n, right, lo + w/2, w/2);
    }
};

static const Bernstein BERNSTEIN;
