// x, l and y as series in a mode, its sign conditions, and the mode after an event by the signs of germs.
// code[i]: -1, +1 with l_i at that end, 0 with y_i = 0. INDEX 1: D is regular on such rows, 2: h_x g_l is, and y is free of l.
#include <cstring>

static const double GERM = 1e-9, TIE = 1e-12;

struct Modes : Model {
    int p, active[M], count;
    bool diagonal, open[M];
    double t, state[NX], guess[M], inverse[M*M], unit, y_size[M], l_size[M], y_largest, l_largest;
    signed char code[M], before[M];

    static bool bounded(int i) { return LO[i] > -INFINITY && UP[i] < INFINITY; }
    static int orders_of_l(int q) { return INDEX == 1 ? q : q - 1; }

    // The inverse of D or h_x g_l on the rows with code 0.
    bool invert()
    {
        static double a[M][2*M];
        double column[M], largest = 0;
        list_active();
        diagonal = true;
        for (int c = 0; c < count; c++) {
            W(active[c], column);
            for (int r = 0; r < count; r++) {
                a[r][c] = column[active[r]];
                diagonal = diagonal && (r == c || a[r][c] == 0);
                largest = larger(largest, fabs(a[r][c]));
            }
        }
        if (count && largest == 0)
            return false;
        if (!diagonal)
            return eliminate(a, largest);
        for (int r = 0; r < count; r++) {
            if (a[r][r] == 0)
                return false;
            inverse[r] = 1/a[r][r];
        }
        return true;
    }

    void apply(const double *right, double *out) const
    {
        for (int r = 0; r < count; r++) {
            if (diagonal) {
                out[r] = inverse[r]*right[r];
                continue;
            }
            out[r] = 0;
            for (int c = 0; c < count; c++)
                out[r] += inverse[r*count + c]*right[c];
        }
    }

    // Orders 0 ... q of x and y, and of l as far as they are determined; false where the mode is singular.
    bool expand(int q, bool with_y = true)
    {
        T[0] = t;
        T[1] = 1;
        for (int k = 2; k <= q; k++)
            T[k] = 0;
        for (int i = 0; i < NX; i++)
            x[i][0] = state[i];
        for (int j = 0; j < M; j++) {
            l[j][0] = code[j] < 0 ? LO[j] : code[j] > 0 ? UP[j] : LINEAR ? 0 : guess[j];
            for (int k = 1; k <= q; k++)
                l[j][k] = 0;
        }
        if (LINEAR && INDEX == 1)
            return expand_direct(q);
        if (with_y)
            H(0);
        for (int k = 0; k < q; k++) {
            if (LINEAR)
                linear_order(k, with_y);
            else if (!newton_order(k))
                return false;
            for (int a = 0; a < count; a++)
                y[active[a]][k + 1] = 0;
        }
        for (int a = 0; a < count; a++) {
            y[active[a]][0] = 0;
            guess[active[a]] = l[active[a]][0];
        }
        return true;
    }

    // The condition of row i at its lower (side 0) or upper end (side 1) as coefficients c; its degree, -1: there is none.
    int condition(int i, int side, int q, double *c) const
    {
        if (code[i] != 0) {
            if (side)
                return -1;
            for (int k = 0; k <= q; k++)
                c[k] = code[i] < 0 ? y[i][k] : -y[i][k];
            return q;
        }
        if (side ? UP[i] == INFINITY : LO[i] == -INFINITY)
            return -1;
        const int n = orders_of_l(q);
        for (int k = 0; k <= n; k++)
            c[k] = side ? -l[i][k] : l[i][k];
        c[0] += side ? UP[i] : -LO[i];
        return n;
    }

    double floor_of(int i) const
    {
        return 1e-5*(code[i] != 0 ? larger(y_size[i], 1e-6*y_largest) : larger(l_size[i], 1e-6*l_largest));
    }

    void grow()
    {
        for (int i = 0; i < M; i++) {
            y_size[i] = larger(y_size[i], fabs(y[i][0]));
            l_size[i] = larger(l_size[i], fabs(l[i][0]));
            y_largest = larger(y_largest, y_size[i]);
            l_largest = larger(l_largest, l_size[i]);
        }
    }

    // The mode at the start of a run; false where none is valid.
    bool begin(const double *x0, double t_end)
    {
        t = T[0] = y_largest = l_largest = 0;
        T[1] = 1;
        unit = 1e-3*t_end;
        for (int i = 0; i < NX; i++)
            state[i] = x[i][0] = x0[i];
        for (int j = 0; j < M; j++) {
            guess[j] = bounded(j) ? (LO[j] + UP[j])/2 : LO[j] > -INFINITY ? LO[j] : 0;
            l[j][0] = INDEX == 2 ? guess[j] : LO[j] > -INFINITY ? LO[j] : 0;
            before[j] = -1;
        }
        H(0);
        for (int i = 0; i < M; i++) {
            y_size[i] = fabs(y[i][0]);
            l_size[i] = bounded(i) ? UP[i] - LO[i] : 0;
            y_largest = larger(y_largest, y_size[i]);
            l_largest = larger(l_largest, l_size[i]);
        }
        for (int i = 0; i < M; i++) {
            open[i] = INDEX == 1 || fabs(y[i][0]) < 1e-14;
            code[i] = INDEX == 1 ? -1 : open[i] ? 0 : y[i][0] > 0 ? -1 : 1;
        }
        return select();
    }

    // A valid mode of the open rows: pivoting on germs, else all modes of a few.
    bool select()
    {
        signed char codes[M];
        bool opened[M];
        memcpy(codes, code, sizeof code);
        memcpy(opened, open, sizeof open);
        if (pivot(60))
            return true;
        memcpy(code, codes, sizeof code);
        memcpy(open, opened, sizeof open);
        return enumerate();
    }

    // Move the state to y_i = 0 on the open rows with code 0.
    void project()
    {
        if (INDEX != 2)
            return;
        for (int sweep = 0; sweep < (LINEAR ? 1 : 2); sweep++)
            for (int i = 0; i < M; i++) {
                if (code[i] != 0 || !open[i])
                    continue;
                double normal[NX], squared = 0;
                T[0] = t;
                for (int j = 0; j < NX; j++)
                    x[j][0] = state[j];
                normal_of(i, normal);
                H(0);
                for (int j = 0; j < NX; j++)
                    squared += normal[j]*normal[j];
                for (int j = 0; j < NX; j++)
                    state[j] -= normal[j]*y[i][0]/squared;
            }
    }

    // x' in the mode.
    void rate(double time, const double *at, double *out)
    {
        t = time;
        memcpy(state, at, sizeof state);
        expand(1, false);
        for (int i = 0; i < NX; i++)
            out[i] = x[i][1];
    }

private:
    void list_active()
    {
        count = 0;
        for (int i = 0; i < M; i++)
            if (code[i] == 0)
                active[count++] = i;
    }

    // Gauss and Jordan with column pivots.
    bool eliminate(double (*a)[2*M], double largest)
    {
        const int n = count;
        for (int r = 0; r < n; r++)
            for (int c = 0; c < n; c++)
                a[r][n + c] = r == c;
        for (int c = 0; c < n; c++) {
            int best = c;
            for (int r = c + 1; r < n; r++)
                if (fabs(a[r][c]) > fabs(a[best][c]))
                    best = r;
            if (fabs(a[best][c]) < 1e-12*largest)
                return false;
            for (int j = 0; best != c && j < 2*n; j++) {
                const double s = a[c][j];
                a[c][j] = a[best][j];
                a[best][j] = s;
            }
            const double d = 1/a[c][c];
            for (int j = 0; j < 2*n; j++)
                a[c][j] *= d;
            for (int r = 0; r < n; r++) {
                const double f = a[r][c];
                for (int j = 0; r != c && f != 0 && j < 2*n; j++)
                    a[r][j] -= f*a[c][j];
            }
        }
        for (int r = 0; r < n; r++)
            for (int c = 0; c < n; c++)
                inverse[r*n + c] = a[r][n + c];
        return true;
    }

    // Index 1: l_k from y_k.
    bool expand_direct(int q)
    {
        double right[M], step[M];
        for (int k = 0; k <= q; k++) {
            H(k);
            if (count) {
                for (int a = 0; a < count; a++)
                    right[a] = -y[active[a]][k];
                apply(right, step);
                for (int a = 0; a < count; a++)
                    l[active[a]][k] = step[a];
                H(k);
                for (int a = 0; a < count; a++)
                    y[active[a]][k] = 0;
            }
            if (k == q)
                break;
            F(k);
            for (int i = 0; i < NX; i++)
                x[i][k + 1] = dx[i]/(k + 1);
            for (int j = 0; j < M; j++)
                if (l[j][k] != 0)
                    add_B(j, l[j][k]/(k + 1), k + 1);
        }
        return true;
    }

    // Index 2, g and h linear: l_k from y_{k+1}.
    void linear_order(int k, bool with_y)
    {
        double right[M], step[M];
        const double d = 1.0/(k + 1);
        F(k);
        for (int i = 0; i < NX; i++)
            x[i][k + 1] = dx[i]*d;
        for (int j = 0; k == 0 && j < M; j++)
            if (code[j] != 0 && l[j][0] != 0)
                add_B(j, l[j][0], 1);
        if (count) {
            H(k + 1);
            for (int a = 0; a < count; a++)
                right[a] = -(k + 1)*y[active[a]][k + 1];
            apply(right, step);
            for (int a = 0; a < count; a++) {
                l[active[a]][k] = step[a];
                add_B(active[a], step[a]*d, k + 1);
            }
        }
        if (with_y || count)
            H(k + 1);
    }

    // The same by Newton's method at order 0, by its last matrix at the others.
    bool newton_order(int k)
    {
        double right[M], step[M];
        for (int iteration = 0; iteration < (k ? 2 : 25); iteration++) {
            F(k);
            for (int i = 0; i < NX; i++)
                x[i][k + 1] = dx[i]/(k + 1);
            H(k + 1);
            if (!count)
                break;
            double worst = 0;
            for (int a = 0; a < count; a++) {
                right[a] = -(k + 1)*y[active[a]][k + 1];
                worst = larger(worst, fabs(right[a]));
            }
            if (k ? iteration == 1 : iteration > 0 && worst <= 1e-2*TIE*(1 + fabs(dx[0])))
                break;
            if (k == 0) {
                linearise();
                if (!invert())
                    return false;
            }
            apply(right, step);
            for (int a = 0; a < count; a++)
                l[active[a]][k] += step[a];
        }
        return true;
    }

    bool prepared()
    {
        if (LINEAR)
            return invert();
        list_active();
        return true;
    }

    int germ(double *c, int n, double scale) const
    {
        double h = 1;
        for (int k = 0; k <= n; k++, h *= unit) {
            c[k] *= h;
            scale = larger(scale, fabs(c[k]));
        }
        for (int k = 0; k <= n; k++)
            if (fabs(c[k]) > GERM*scale && scale > 1e-300)
                return c[k] > 0 ? 1 : -1;
        return 0;
    }

    // The conditions that fail just after, as the codes that they ask for.
    int wrong_rows(int q, signed char *next)
    {
        double c[PM + 2];
        int wrong = 0;
        memcpy(next, code, sizeof code);
        for (int i = 0; i < M; i++) {
            if (!open[i] && code[i] != 0)
                continue;
            for (int side = 0; side < 2; side++) {
                const int n = condition(i, side, q, c);
                if (n < 0)
                    continue;
                if (open[i] && code[i] != 0 && INDEX == 2)
                    c[0] = 0;
                const double end = side ? UP[i] : LO[i];
                if (open[i] ? germ(c, n, floor_of(i)) >= 0 : c[0] >= -GERM*(1 + fabs(end)))
                    continue;
                next[i] = code[i] != 0 ? 0 : side ? 1 : -1;
                wrong++;
            }
        }
        return wrong;
    }

    bool leave_singular()
    {
        bool any = false;
        for (int i = 0; i < M; i++)
            if (open[i] && code[i] == 0) {
                code[i] = -before[i];
                any = true;
                if (UP[i] == INFINITY)
                    return false;
            }
        return any;
    }

    bool pivot(int most)
    {
        const int q = p < 3 ? 3 : p < 6 ? p : 6;
        for (int turn = 0; turn < most; turn++) {
            if (!prepared() || !expand(q)) {
                if (most == 1 || !leave_singular())
                    return false;
                continue;
            }
            signed char next[M];
            if (!wrong_rows(q, next)) {
                grow();
                return true;
            }
            if (most == 1)
                return false;
            for (int i = 0; i < M; i++)
                if (next[i] != code[i]) {
                    open[i] = true;
                    if (code[i] != 0)
                        before[i] = code[i];
                    code[i] = next[i];
                    if (turn >= 12)
                        break;
                }
        }
        return false;
    }

    bool enumerate()
    {
        int rows[M], n = 0;
        long total = 1;
        for (int i = 0; i < M; i++)
            if (open[i]) {
                rows[n++] = i;
                total *= bounded(i) ? 3 : 2;
            }
        if (n > 9)
            return false;
        for (long number = 0; number < total; number++) {
            long rest = number;
            for (int r = 0; r < n; r++) {
                const int codes = bounded(rows[r]) ? 3 : 2;
                code[rows[r]] = rest % codes == 0 ? 0 : rest % codes == 1 ? -1 : 1;
                rest /= codes;
            }
            if (pivot(1))
                return true;
        }
        return false;
    }
};
