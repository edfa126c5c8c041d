/* What a piece of collocation errs by inside: event_driven/collocation.py. */

#if STIFF
#define SIDES MODEL_PIECES_SIDES

/* The largest value on the real part of a disc. */
static double on_real(const double *y, int m)
{
    double sum = 0, power = 1;
    for (int k = 0; k <= m; k++, power /= COVER_RADIUS)
        sum += fabs(y[k])*power;
    return sum + (y[m + 1] != 0 ? y[m + 1]*power : 0);
}

/* A polynomial about the middle of a piece, a column of SIDES, about another centre. */
static void about(const double *coefficients, int n, double centre, double *c)
{
    for (int k = 0; k < n; k++)
        c[k] = coefficients[k*SIDES];
    recentre(n, c, centre - 0.5);
}

#define DISC_F(i) ROW(DISC_ROWS + (i))
#define DISC_H(i) DISC_F(N + (i))

/* A polynomial of n coefficients as a form of degree m >= n - 1 on the disc of radius R. */
static void fill_disc(double *y, const double *c, int n, double R, int m)
{
    double power = 1;
    for (int k = 0; k <= m + 1; k++, power *= R)
        y[k] = k < n ? c[k]*power : 0;
}

/* f + g and h on the disc. */
static void sums_on_disc(model_pieces *s, int m)
{
    for (int i = 0; i < N; i++)
        copied(DISC_F(i), ROW(disc_f[i]), m);
#if LAW
#if B_NUMBERS
    for (int j = 0; j < M; j++)
        for (int e = B_start[j]; e < B_start[j + 1]; e++)
            disc_sum(DISC_F(B_row[e]), DISC_F(B_row[e]), B_value[e], DISC_L(j), m);
#else
    for (int i = 0; i < N; i++)
        disc_sum(DISC_F(i), DISC_F(i), 1, ROW(disc_g[i]), m);
#endif
    for (int i = 0; i < M; i++)
        copied(DISC_H(i), ROW(disc_h[i]), m);
#if FEED
#if D_NUMBERS
    for (int i = 0; i < M; i++)
        for (int e = D_start[i]; e < D_start[i + 1]; e++)
            disc_sum(DISC_H(i), DISC_H(i), D_value[e], DISC_L(D_column[e]), m);
#endif
#endif
#endif
}

/* The larger of worst and the error beside what is allowed, but for rounding; infinite where it is not a number. */
static double beside(double worst, double e, double rounding, double weight, double allowed)
{
    double seen = (fabs(e) - rounding)*weight;
    if (seen <= 0)
        return worst;
    seen /= allowed;
    return seen == seen ? max_of(worst, seen) : INFINITY;
}

/* The larger of worst and what a disc is beside such a polynomial, beside 100 rtol of its size. */
static double beside_polynomial(double worst, const double *coefficients, int n, double centre, double R, const double *of,
                                double size, double rtol, int m)
{
    double c[DEGREES], form[DEGREES];
    about(coefficients, n, centre, c);
    fill_disc(form, c, n, R, m);
    disc_sum(form, form, -1, of, m);
    return beside(worst, on_real(form, m), STAGE_ROUNDING*size, 1, MULTIPLIERS*rtol*size);
}

/* What a piece of collocation errs by on one disc; see cover(). */
static double on_part(model_pieces *s, const double *coefficients, int n, double h, double centre, double half, double rtol,
                      const double *inverse, int q, const double *size, const double *rounding)
{
    const int m = n - 1 > COVER_DEGREE ? n - 1 : COVER_DEGREE;
    const double R = COVER_RADIUS*half, t[] = {s->at.t + h*centre, h};
    double c[DEGREES], form[DEGREES], worst = 0;
    fill_disc(DISC_T, t, 2, R, m);
    for (int i = 0; i < N + M; i++) {
        about(coefficients + (i < N ? i : L + i - N), n, centre, c);
        fill_disc(DISC_X(i), c, n, R, m);
    }
    run_lines(s, DISC_LINES, m, 1);
    sums_on_disc(s, m);
    for (int i = 0; i < N; i++) {
        about(coefficients + i, n, centre, c);
        for (int k = 1; k < n; k++)
            c[k - 1] = k*c[k];
        fill_disc(form, c, n - 1, R, m);
        disc_scaled(DISC_F(i), DISC_F(i), h, m);
        disc_sum(DISC_F(i), DISC_F(i), -1, form, m);
        if (!(DISC_F(i)[m + 1] < INFINITY))
            return INFINITY;
    }
#if LAW
    for (int a = 0; a < HOW.n; a++) {
        disc_scaled(DISC_H(HOW.active[a]), DISC_H(HOW.active[a]), -1, m);
        if (!(DISC_H(HOW.active[a])[m + 1] < INFINITY))
            return INFINITY;
    }
#endif
    for (int j = 0; j < q; j++) {
        double sum[DEGREES] = {0}, allowed;
        for (int k = 0; k < q; k++) {
#if LAW
            const double *missed = k < N ? DISC_F(k) : DISC_H(HOW.active[k - N]);
#else
            const double *missed = DISC_F(k);
#endif
            const double factor = inverse[k*q + j];
            if (factor != 0)
                disc_sum(sum, sum, factor, missed, m);
        }
#if LAW
        allowed = j < N ? rtol*size[j] + INNER_SHARE*s->atol[j] : MULTIPLIERS*rtol*size[L + HOW.active[j - N]];
#else
        allowed = rtol*size[j] + INNER_SHARE*s->atol[j];
#endif
        worst = beside(worst, on_real(sum, m), rounding[j], 1, allowed);
    }
#if LAW
    for (int i = 0; i < M; i++)
        if (s->at.codes[i])
            worst = beside_polynomial(worst, coefficients + Y + i, n, centre, R, DISC_H(i), size[Y + i], rtol, m);
#endif
#if SWITCHED
    for (int b = 0; b < CHOICES; b++)
        worst = beside_polynomial(worst, coefficients + ROWS + b, n, centre, R, ROW(disc_looked[b]), size[ROWS + b], rtol, m);
#endif
    return worst;
}

/* The largest bound of what a piece of collocation errs by inside: by forms on discs that cover it, smaller ones where that is too
   large; its polynomials, of n coefficients, about its middle, in its own length. */
static double cover(model_pieces *s, const double *coefficients, int n, double h, double rtol, const double *inverse, int q,
                    const double *size, const double *rounding)
{
    double worst = 0, at = 0, width = 1;
    while (at < 1) {
        const double here = on_part(s, coefficients, n, h, at + width/2, width/2, rtol, inverse, q, size, rounding);
        if (here <= 1) {
            worst = max_of(worst, here);
            at += width;
            while (width < 1 && fmod(at, 2*width) == 0) /* the other half of the next wider one is done */
                width *= 2;
        } else if (width > SMALLEST)
            width /= 2;
        else
            return here;
    }
    return worst;
}
#endif
