// Radau IIA collocation on the modes of a linear system whose rows are all at an end: pieces are polynomials of degree STAGES.
struct Factors {
    double a[STAGES*NX][STAGES*NX];
    int pivots[STAGES*NX];
    bool known = false;

    void factor()
    {
        const int n = STAGES*NX;
        for (int c = 0; c < n; c++) {
            int best = c;
            for (int r = c + 1; r < n; r++)
                if (fabs(a[r][c]) > fabs(a[best][c]))
                    best = r;
            pivots[c] = best;
            for (int j = 0; best != c && j < n; j++) {
                const double s = a[c][j];
                a[c][j] = a[best][j];
                a[best][j] = s;
            }
            for (int r = c + 1; r < n; r++) {
                const double m = a[r][c] /= a[c][c];
                for (int j = c + 1; m != 0 && j < n; j++)
                    a[r][j] -= m*a[c][j];
            }
        }
        known = true;
    }

    void solve(double *b) const
    {
        const int n = STAGES*NX;
        for (int c = 0; c < n; c++) {
            const double s = b[pivots[c]];
            b[pivots[c]] = b[c];
            b[c] = s;
        }
        for (int c = 0; c < n; c++)
            for (int r = c + 1; r < n; r++)
                b[r] -= a[r][c]*b[c];
        for (int c = n - 1; c >= 0; c--) {
            b[c] /= a[c][c];
            for (int r = 0; r < c; r++)
                b[r] -= a[r][c]*b[c];
        }
    }
};

struct Radau : Modes {
    static const int START = -14, LEAST = -58;  // Powers of 2: lengths of pieces beside t_end.
    double jacobian[NX][NX], size[NX], largest, piece[NX][STAGES + 1];
    long events, steps;

    int run(double t_end, const double *x0, double tol, int rows, double *out, double *times, int room)
    {
        static Factors factors[80], last_factors;
        for (Factors &f : factors)
            f.known = false;
        p = 6;
        events = steps = 0;
        if (!begin(x0, t_end))
            return 2;
        double at[NX], time = 0;
        memcpy(at, x0, sizeof at);
        largest = 0;
        for (int i = 0; i < NX; i++)
            size[i] = 0;
        grow_states(at);
        differentiate(at);
        const double pitch = t_end/(rows - 1), goal = 0.3*pow(tol, STAGES/(2.0*STAGES - 1));
        for (int row = 0, e = START; time < t_end;) {
            double h = ldexp(t_end, e);
            const bool last = time + h >= t_end*(1 - 1e-15);
            Factors &f = last ? last_factors : factors[e + 60];
            if (last) {
                h = t_end - time;
                f.known = false;
            }
            const double error = collocate(time, h, at, f);
            if (error > goal && e > LEAST) {
                e--;
                continue;
            }
            if (++steps > 1000000)
                return 6;
            int hit = -1;
            const double s = first_event(h, &hit);
            const bool ended = last && hit < 0;
            for (; row < rows - (ended ? 0 : 1) && row*pitch <= time + s*h*(1 + 1e-15); row++)
                for (int i = 0; i < NX; i++)
                    out[row*NX + i] = horner(piece[i], STAGES, (row*pitch - time)/h);
            for (int i = 0; i < NX; i++)
                at[i] = horner(piece[i], STAGES, s);
            grow_states(at);
            time = ended ? t_end : time + s*h;
            for (int i = 0; i < M; i++)
                open[i] = false;
            if (hit < 0) {
                e += error < goal*pow(0.5, STAGES + 0.5);
                continue;
            }
            if (events < room)
                times[events] = time;
            events++;
            open[hit] = true;
            before[hit] = code[hit];
            code[hit] = 0;
            t = time;
            memcpy(state, at, sizeof state);
            unit = 1e-3*h;  // The germ of a stiff mode is shorter than its pieces.
            if (!select())
                return 4;
            e = e < START ? e : START;
        }
        return 0;
    }

private:
    void grow_states(const double *at)
    {
        for (int i = 0; i < NX; i++) {
            size[i] = larger(size[i], fabs(at[i]));
            largest = larger(largest, size[i]);
        }
    }

    void differentiate(const double *at)
    {
        double moved[NX], f0[NX], f1[NX];
        rate(0, at, f0);
        for (int j = 0; j < NX; j++) {
            memcpy(moved, at, sizeof moved);
            moved[j] += 1;
            rate(0, moved, f1);
            for (int i = 0; i < NX; i++)
                jacobian[i][j] = f1[i] - f0[i];
        }
    }

    // The piece from one linear system; its last coefficient is what its error is bounded by.
    double collocate(double time, double h, const double *at, Factors &f)
    {
        if (!f.known) {
            for (int r = 0; r < STAGES; r++)
                for (int c = 0; c < STAGES; c++)
                    for (int i = 0; i < NX; i++)
                        for (int j = 0; j < NX; j++)
                            f.a[r*NX + i][c*NX + j] = (r == c && i == j) - h*RADAU_A[r][c]*jacobian[i][j];
            f.factor();
        }
        double slopes[STAGES*NX], error = 0;
        for (int r = 0; r < STAGES; r++)
            rate(time + RADAU_C[r]*h, at, slopes + r*NX);
        f.solve(slopes);
        for (int i = 0; i < NX; i++) {
            piece[i][0] = at[i];
            for (int k = 0; k < STAGES; k++) {
                double v = 0;
                for (int r = 0; r < STAGES; r++)
                    v += RADAU_P[k][r]*slopes[r*NX + i];
                piece[i][k + 1] = h*v;
            }
            error = larger(error, fabs(piece[i][STAGES])/larger(size[i], 1e-6*largest)/ldexp(1, 2*STAGES - 1));
        }
        return error;
    }

    double first_event(double h, int *hit)
    {
        double c[PM + 2], first = 1;
        for (int i = 0; i < NX; i++)
            memcpy(x[i], piece[i], sizeof piece[i]);
        T[1] = h;
        for (int j = 0; j < M; j++) {
            l[j][0] = code[j] < 0 ? LO[j] : UP[j];
            for (int k = 1; k <= STAGES; k++)
                l[j][k] = 0;
        }
        for (int k = 0; k <= STAGES; k++)
            H(k);
        for (int i = 0; i < M; i++) {
            const int n = condition(i, 0, STAGES, c);
            double low = c[0];
            for (int k = 1; k <= n; k++)
                low -= fabs(c[k]);
            if (low > 0)
                continue;
            int skip = 0;
            if (open[i]) {
                double scale = floor_of(i);
                for (int k = 0; k <= n; k++)
                    scale = larger(scale, fabs(c[k]));
                skip = 1;
                while (skip <= n && fabs(c[skip]) <= 1e-11*scale)
                    skip++;
                if (skip > n)
                    continue;
            }
            const double s = BERNSTEIN.first_root(c + skip, n - skip);
            if (s <= 1 && (s < first || *hit < 0)) {
                first = s;
                *hit = i;
            }
        }
        return first;
    }
};
