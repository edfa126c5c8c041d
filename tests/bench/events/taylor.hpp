// The run: pieces whose length follows from their last two coefficients, each ended by its first event.
struct Taylor : Modes {
    double tol, size[NX], largest, c_scale[M];
    long events, steps;

    // 0, or what went wrong: 2 no mode at the start, 3 a singular one, 4 none after an event, 5 too many events, 6 too long.
    int run(double t_end, const double *x0, double tolerance, int order, int rows, double *out, double *times, int room)
    {
        tol = tolerance;
        p = order;
        events = steps = 0;
        if (!begin(x0, t_end))
            return 2;
        largest = 0;
        for (int i = 0; i < NX; i++)
            size[i] = fabs(x0[i]);
        grow_states();
        const double pitch = t_end/(rows - 1);
        int row = 0, tiny = 0;
        while (t < t_end) {
            if (!expand(p))
                return 3;
            if (++steps > 2000000)
                return 6;
            double h = t_end - t;
            const double longest = length(h);
            const bool last = longest >= h;
            if (!last)
                h = longest;
            int hit = -1, side = 0;
            const double s = h*first_event(h, &hit, &side);
            const bool ended = last && hit < 0;
            for (; row < rows - (ended ? 0 : 1) && row*pitch <= t + s*(1 + 1e-15); row++)
                for (int i = 0; i < NX; i++)
                    out[row*NX + i] = horner(x[i], p, row*pitch - t);
            if (hit >= 0)
                note_scales(s);
            for (int i = 0; i < NX; i++)
                state[i] = horner(x[i], p, s);
            grow_states();
            for (int i = 0; i < M; i++)
                open[i] = false;
            t = ended ? t_end : t + s;
            unit = h;
            if (hit < 0)
                continue;
            if (!polish(hit, side, h))
                return 3;
            if (touch(hit, side, t_end))
                continue;
            if (events < room)
                times[events] = t;
            events++;
            tiny = s < 1e-13*t_end ? tiny + 1 : 0;
            if (tiny > 50)
                return 5;
            switch_rows(hit, side);
            project();
            if (!select())
                return 4;
        }
        return 0;
    }

private:
    void grow_states()
    {
        for (int i = 0; i < NX; i++) {
            size[i] = larger(size[i], fabs(state[i]));
            largest = larger(largest, size[i]);
        }
    }

    double length(double h)
    {
        const int n_l = orders_of_l(p);
        double e1 = 0, e2 = 0, m1 = 0, m2 = 0;
        for (int i = 0; i < NX; i++) {
            const double s = larger(size[i], 1e-6*largest);
            e1 = larger(e1, fabs(x[i][p])/s);
            e2 = larger(e2, fabs(x[i][p - 1])/s);
        }
        grow();
        for (int i = 0; i < M; i++) {
            const double *c = code[i] != 0 ? y[i] : l[i];
            const int n = code[i] != 0 ? p : n_l;
            const double s = code[i] != 0 ? larger(y_size[i], 1e-3*y_largest) : larger(l_size[i], 1e-3*l_largest);
            if (s <= 0)
                continue;
            const double a1 = fabs(c[n])/s, a2 = fabs(c[n - 1])/s;
            if (n == p) {
                e1 = larger(e1, a1/100);
                e2 = larger(e2, a2/100);
            } else {
                m1 = larger(m1, a1);
                m2 = larger(m2, a2);
            }
        }
        if (e1 > 0)
            h = pow(tol/e1, 1.0/p);
        if (e2 > 0) {
            const double other = pow(tol/e2, 1.0/(p - 1));
            h = other < h || e1 == 0 ? other : h;
        }
        if (m1 > 0)
            h = smaller(h, pow(100*tol/m1, 1.0/n_l));
        if (m2 > 0)
            h = smaller(h, pow(100*tol/m2, 1.0/(n_l - 1)));
        return h;
    }

    // The share of h at which the first condition becomes negative; 1 where none does.
    double first_event(double h, int *hit, int *hit_side) const
    {
        double powers[PM + 2], c[PM + 2], first = 1;
        powers[0] = 1;
        for (int k = 1; k <= p; k++)
            powers[k] = powers[k - 1]*h;
        for (int i = 0; i < M; i++)
            for (int side = 0; side < 2; side++) {
                const int n = condition(i, side, p, c);
                if (n < 0)
                    continue;
                double low = c[0];
                for (int k = 1; k <= n; k++) {
                    c[k] *= powers[k];
                    low -= fabs(c[k]);
                }
                if (low > 0)
                    continue;
                int skip = 0;
                if (open[i]) {
                    double scale = floor_of(i);
                    for (int k = 0; k <= n; k++)
                        scale = larger(scale, fabs(c[k]));
                    skip = code[i] != 0 && INDEX == 2 ? 1 : 0;
                    while (skip <= n && fabs(c[skip]) <= GERM*scale)
                        skip++;
                    if (skip > n)
                        continue;
                }
                double power = first;
                for (int k = 1; first < 1 && k <= n; k++, power *= first)
                    c[k] *= power;
                const double s = BERNSTEIN.first_root(c + skip, n - skip);
                if (s <= 1) {
                    first *= s;
                    *hit = i;
                    *hit_side = side;
                }
            }
        return first;
    }

    void note_scales(double s)
    {
        for (int i = 0; i < M; i++) {
            const double *c = code[i] != 0 ? y[i] : l[i];
            const int n = code[i] != 0 ? p : orders_of_l(p);
            double power = 1;
            c_scale[i] = 1e5*floor_of(i);
            for (int k = 0; k <= n; k++, power *= s)
                c_scale[i] = larger(c_scale[i], fabs(c[k])*power);
        }
    }

    void move(int q, double d)
    {
        for (int i = 0; i < NX; i++)
            state[i] = horner(x[i], q, d);
        t += d;
    }

    // Go to where the condition is 0 to rounding, on expansions there.
    bool polish(int hit, int side, double h)
    {
        const int q = p < 4 ? p : 4;
        double c[PM + 2];
        for (int iteration = 0; iteration < 6; iteration++) {
            if (!expand(q))
                return false;
            const int n = condition(hit, side, q, c);
            if (n < 0 || fabs(c[0]) <= 1e-3*TIE*c_scale[hit] || c[1] == 0)
                break;
            double d = -c[0]/c[1];
            if (!(fabs(d) < 0.1*h))
                break;
            for (int repeat = 0; repeat < 3; repeat++) {
                double v = c[n], e = 0;
                for (int k = n - 1; k >= 0; k--) {
                    e = e*d + v;
                    v = v*d + c[k];
                }
                if (e != 0 && fabs(v/e) < 0.1*h)
                    d -= v/e;
            }
            move(q, d);
        }
        return true;
    }

    // A condition that comes to 0 and goes back within rounding is no event: step past it.
    bool touch(int hit, int side, double t_end)
    {
        const int q = p < 4 ? p : 4;
        double c[PM + 2];
        const int n = condition(hit, side, q, c);
        const double tie = TIE*c_scale[hit];
        if (n < 2 || c[2] <= 0 || fabs(c[0]) > tie || c[1]*c[1] > 4*c[2]*tie)
            return false;
        move(q, 3*sqrt(tie/c[2]) + fabs(c[1])/c[2]);
        t = smaller(t, t_end);
        return true;
    }

    void switch_rows(int hit, int hit_side)
    {
        double c[PM + 2];
        for (int i = 0; i < M; i++) {
            int end = -1;
            for (int side = 1; side >= 0; side--)
                if (condition(i, side, 1, c) >= 0 && (fabs(c[0]) <= TIE*c_scale[i] || (i == hit && side == hit_side)))
                    end = side;
            if (end < 0)
                continue;
            open[i] = true;
            before[i] = code[i];
            code[i] = code[i] != 0 ? 0 : end ? 1 : -1;
        }
    }
};
