/* Analytic functions on a disc, as in event_driven/disc_arithmetic.py: c[0] + ... + c[m] w^m + rest, |w| <= 1; of degree 0 a ball. */

@KINDS@
typedef struct {
    unsigned char kind, last; /* see codegen/recurrences.py; whether no other line reads it */
    short choice; /* of its branch */
    int y, a, b; /* rows */
    double number;
} disc_line;

@TABLE@
#define REST (m + 1) /* of a row: its place behind the coefficients */
#define DEGREES (MOST_ORDERS + 2)
#define ROW(i) (s->discs + (size_t)(i)*DEGREES) /* t, x and l first; then those of codegen/recurrences.py */

static double moves_of(const double *u, int m)
{
    double sum = u[REST];
    for (int k = 1; k <= m; k++)
        sum += fabs(u[k]);
    return sum;
}

static void lose(double *y, int m)
{
    memset(y, 0, (m + 1)*sizeof *y);
    y[REST] = INFINITY;
}

/* The rest: the majorant at the rim less what of it is kept. */
static void close_form(double *y, const double *majorant, double whole, int m)
{
    double kept = 0;
    for (int k = 0; k <= m; k++)
        kept += majorant[k];
    y[REST] = whole < INFINITY ? max_of(whole - kept, 0) + (m ? (m + 1 + FUNCTION_ROUNDINGS)*EPS*whole : 0) : INFINITY;
}

/* What the product of forms leaves: of |a| |b| what is beyond the degree, and rounding; 0 where one of them is 0, and there alone. */
static double rest_of_product(const double *a, const double *b, int m)
{
    double size = a[REST], tail = b[REST], rest = 0; /* tail: of |b|, from an order on */
    for (int k = 0; k <= m; k++) {
        rest += fabs(a[k])*tail;
        size += fabs(a[k]);
        tail += fabs(b[m - k]);
    }
    if (size == 0 || tail == 0)
        return 0;
    const double whole = size*tail;
    return whole < INFINITY ? max_of(rest + a[REST]*tail + (m + 1 + PRODUCT_ROUNDINGS)*EPS*whole, NOTHING) : INFINITY;
}

static void disc_product(double *y, const double *a, const double *b, int m)
{
    if (m == 0) {
        const double size = fabs(b[0]) + b[1], r = (a[0] != 0 ? fabs(a[0])*b[1] : 0) + (a[1] != 0 && size != 0 ? a[1]*size : 0);
        y[0] = a[0]*b[0];
        y[1] = r;
        return;
    }
    double out[DEGREES];
    for (int k = 0; k <= m; k++) {
        double sum = 0;
        if (a == b) {
            for (int j = 0; 2*j < k; j++)
                sum += a[j]*a[k - j];
            sum = 2*sum + (k % 2 ? 0 : a[k/2]*a[k/2]);
        } else
            for (int j = 0; j <= k; j++)
                sum += a[j]*b[k - j];
        out[k] = sum;
    }
    out[REST] = rest_of_product(a, b, m);
    if (out[REST] == 0)
        memset(out, 0, (m + 1)*sizeof *out);
    memcpy(y, out, (m + 2)*sizeof *y);
}

static void disc_scaled(double *y, const double *a, double factor, int m)
{
    for (int k = 0; k <= m; k++)
        y[k] = factor*a[k];
    y[REST] = factor != 0 ? fabs(factor)*a[REST] : 0;
}

static void disc_quotient(double *y, const double *n, const double *a, int m)
{
    const double size = fabs(a[0]), v = moves_of(a, m);
    double Q[DEGREES], out[DEGREES];
    if (!(v < size)) {
        lose(y, m);
        return;
    }
    if (m == 0) {
        const double r = (n[1] + fabs(n[0])*v/size)/(size - v);
        y[0] = n[0]/a[0];
        y[1] = r;
        return;
    }
    for (int k = 0; k <= m; k++) {
        double sum = n[k], most = fabs(n[k]);
        for (int j = 0; j < k; j++) {
            sum -= out[j]*a[k - j];
            most += Q[j]*fabs(a[k - j]);
        }
        out[k] = sum/a[0];
        Q[k] = most/size;
    }
    close_form(out, Q, (fabs(n[0]) + moves_of(n, m))/(size - v), m);
    memcpy(y, out, (m + 2)*sizeof *y);
}

static void disc_exp(double *y, const double *a, int m)
{
    const double e = exp(a[0]), whole = exp(a[0] + moves_of(a, m));
    double Q[DEGREES], out[DEGREES];
    if (!(whole < INFINITY)) {
        lose(y, m);
        return;
    }
    out[0] = Q[0] = e;
    for (int k = 1; k <= m; k++) {
        double sum = 0, most = 0;
        for (int j = 1; j <= k; j++) {
            sum += j*a[j]*out[k - j];
            most += j*fabs(a[j])*Q[k - j];
        }
        out[k] = sum/k;
        Q[k] = most/k;
    }
    close_form(out, Q, whole, m);
    if (m == 0)
        out[1] = -whole*expm1(-a[1]);
    memcpy(y, out, (m + 2)*sizeof *y);
}

static void disc_wave(double *y, const double *a, int m, int cosine)
{
    const double s = sin(a[0]), c = cos(a[0]), v = moves_of(a, m), one = fabs(cosine ? c : s), two = fabs(cosine ? s : c);
    double of_sin[DEGREES], of_cos[DEGREES], up[DEGREES], over[DEGREES], Q[DEGREES];
    if (!(v < MOST_EXPONENT)) {
        lose(y, m);
        return;
    }
    const double e = expm1(v), sinh_v = 0.5*(e + e/(1 + e)), cosh_less_1 = 0.5*e*(e/(1 + e));
    if (m == 0) {
        y[0] = cosine ? c : s;
        y[1] = two*sinh_v + one*cosh_less_1;
        return;
    }
    of_sin[0] = s; of_cos[0] = c; up[0] = 0; over[0] = 1; Q[0] = one;
    for (int k = 1; k <= m; k++) {
        double p = 0, q = 0, h = 0, g = 0;
        for (int j = 1; j <= k; j++) {
            const double w = j*a[j];
            p += w*of_cos[k - j];
            q -= w*of_sin[k - j];
            h += fabs(w)*over[k - j];
            g += fabs(w)*up[k - j];
        }
        of_sin[k] = p/k; of_cos[k] = q/k; up[k] = h/k; over[k] = g/k;
        Q[k] = one*over[k] + two*up[k];
    }
    double out[DEGREES];
    memcpy(out, cosine ? of_cos : of_sin, (m + 1)*sizeof *out);
    close_form(out, Q, one*(1 + cosh_less_1) + two*sinh_v, m);
    memcpy(y, out, (m + 2)*sizeof *y);
}

static void disc_root(double *y, const double *u, int m)
{
    const double a = u[0], v = moves_of(u, m);
    double Q[DEGREES], S[DEGREES], out[DEGREES];
    if (!(v < a)) {
        const int still = v == 0 && a == 0;
        lose(y, m);
        y[REST] = still ? 0 : INFINITY;
        return;
    }
    out[0] = S[0] = Q[0] = sqrt(a);
    for (int k = 1; k <= m; k++) {
        double sum = u[k], most = -fabs(u[k]);
        for (int j = 1; j < k; j++) {
            sum -= out[j]*out[k - j];
            most -= S[j]*S[k - j];
        }
        out[k] = sum/(2*out[0]);
        S[k] = most/(2*S[0]);
        Q[k] = -S[k];
    }
    close_form(out, Q, 2*sqrt(a) - sqrt(a - v), m);
    if (m == 0)
        out[1] = v/(sqrt(a) + sqrt(a - v));
    memcpy(y, out, (m + 2)*sizeof *y);
}

/* phi(u), by its coefficients at the centre and a majorant's; whole: the majorant at the rim. */
static void compose(double *y, const double *u, const double *phi, const double *majorant, double whole, int m)
{
    double out[DEGREES] = {0}, Q[DEGREES] = {0}, next[DEGREES], most[DEGREES];
    for (int j = m; j >= 0; j--) {
        for (int k = 0; k <= m; k++) {
            next[k] = most[k] = 0;
            for (int i = 1; i <= k; i++) {
                next[k] += u[i]*out[k - i];
                most[k] += fabs(u[i])*Q[k - i];
            }
        }
        memcpy(out, next, (m + 1)*sizeof *out);
        memcpy(Q, most, (m + 1)*sizeof *Q);
        out[0] += phi[j];
        Q[0] += majorant[j];
    }
    close_form(out, Q, whole, m);
    memcpy(y, out, (m + 2)*sizeof *y);
}

static void disc_power(double *y, const double *u, double p, int m)
{
    const double a = u[0], v = moves_of(u, m), x = v/fabs(a);
    double phi[DEGREES], Q[DEGREES], of[DEGREES];
    if (v == 0 && a == 0 && p > 0) {
        lose(y, m);
        y[REST] = 0;
        return;
    }
    if (!(v < fabs(a)) || (a < 0 && p != floor(p)) || (m && !(a > 0))) {
        lose(y, m);
        return;
    }
    phi[0] = pow(a, p);
    Q[0] = fabs(phi[0]);
    for (int j = 0; j < m; j++) {
        phi[j + 1] = phi[j]*(p - j)/(j + 1);
        Q[j + 1] = Q[j]*(fabs(p) + j)/(j + 1);
    }
    if (m == 0) {
        y[0] = phi[0];
        y[1] = v > 0 ? fabs(p)*v*pow(fabs(a) + (p >= 1 ? v : -v), p - 1) : 0;
        if (!(y[1] < INFINITY))
            lose(y, m);
        return;
    }
    disc_scaled(of, u, 1/a, m);
    compose(y, of, phi, Q, Q[0]*pow(1 - x, -fabs(p)), m);
}

static void disc_log(double *y, const double *u, int m)
{
    const double a = u[0], v = moves_of(u, m);
    double phi[DEGREES], Q[DEGREES], of[DEGREES];
    if (!(v < a)) {
        lose(y, m);
        return;
    }
    phi[0] = log(a);
    Q[0] = fabs(phi[0]);
    for (int j = 1; j <= m; j++) {
        Q[j] = 1.0/j;
        phi[j] = j % 2 ? Q[j] : -Q[j];
    }
    disc_scaled(of, u, 1/a, m);
    compose(y, of, phi, Q, Q[0] - log1p(-v/a), m);
}

static void disc_atan(double *y, const double *u, int m)
{
    const double a = u[0], v = moves_of(u, m), radius = sqrt(1 + a*a);
    double d[DEGREES], phi[DEGREES], Q[DEGREES], power = 1;
    if (!(v < radius)) {
        lose(y, m);
        return;
    }
    phi[0] = atan(a);
    Q[0] = fabs(phi[0]);
    for (int k = 0; k <= m; k++)
        d[k] = ((k == 0) - (k > 0 ? 2*a*d[k - 1] : 0) - (k > 1 ? d[k - 2] : 0))/(1 + a*a);
    for (int j = 1; j <= m; j++) {
        power /= radius;
        phi[j] = d[j - 1]/j;
        Q[j] = power/j;
    }
    compose(y, u, phi, Q, Q[0] - log1p(-v/radius), m);
}

static void disc_asin(double *y, const double *u, int m)
{
    const double a = u[0], v = moves_of(u, m), g = 1 - a*a;
    double d[DEGREES], phi[DEGREES], Q[DEGREES];
    if (!(fabs(a) + v < 1)) {
        lose(y, m);
        if (v == 0 && g == 0) {
            y[0] = asin(a);
            y[REST] = 0;
        }
        return;
    }
    d[0] = 1/sqrt(g);
    for (int k = 1; k <= m; k++)
        d[k] = ((-0.5 - (k - 1))*-2*a*d[k - 1] + (k > 1 ? (-1.0 - (k - 2))*-1*d[k - 2] : 0))/(k*g);
    phi[0] = asin(a);
    Q[0] = fabs(phi[0]);
    for (int j = 1; j <= m; j++) {
        phi[j] = d[j - 1]/j;
        Q[j] = fabs(phi[j]);
    }
    compose(y, u, phi, Q, asin(fabs(a) + v), m);
}

static void disc_erf(double *y, const double *u, int m)
{
    const double a = u[0], v = moves_of(u, m), slope = TWO_OVER_ROOT_PI*exp(-a*a);
    const double steepest = TWO_OVER_ROOT_PI*exp((2*fabs(a) + v)*v - a*a);
    double d[DEGREES], D[DEGREES], phi[DEGREES], Q[DEGREES];
    d[0] = D[0] = slope;
    for (int j = 1; j <= m; j++) {
        d[j] = (-2*a*d[j - 1] - (j > 1 ? 2*d[j - 2] : 0))/j;
        D[j] = (2*fabs(a)*D[j - 1] + (j > 1 ? 2*D[j - 2] : 0))/j;
    }
    phi[0] = erf(a);
    Q[0] = fabs(phi[0]);
    for (int j = 1; j <= m; j++) {
        phi[j] = d[j - 1]/j;
        Q[j] = D[j - 1]/j;
    }
    compose(y, u, phi, Q, v > 0 ? Q[0] + v*steepest : Q[0], m);
}

static void disc_sum(double *y, const double *a, double factor, const double *b, int m)
{
    for (int k = 0; k <= m; k++)
        y[k] = a[k] + factor*b[k];
    y[REST] = a[REST] + (factor != 0 ? fabs(factor)*b[REST] : 0);
}

static void disc_shifted(double *y, const double *a, double number, int m)
{
    memmove(y, a, (m + 2)*sizeof *y);
    y[0] += number;
}

static void disc_tanh(double *y, const double *a, int m)
{
    const double sign = a[0] > 0 ? -1 : 1;
    double e[DEGREES], below[DEGREES];
    disc_scaled(e, a, 2*sign, m);
    disc_exp(e, e, m);
    disc_shifted(below, e, 1, m);
    disc_quotient(y, e, below, m);
    disc_scaled(y, y, 2*sign, m);
    y[0] -= sign;
}

static void disc_hypot(double *y, const double *a, const double *b, int m)
{
    double one[DEGREES], two[DEGREES];
    disc_product(one, a, a, m);
    disc_product(two, b, b, m);
    disc_sum(one, one, 1, two, m);
    disc_root(y, one, m);
}

/* atan2: turned to its centre, where the disc does not meet the cut. */
static void disc_angle(double *y, const double *a, const double *b, int m)
{
    const double a0 = a[0], b0 = b[0];
    double above[DEGREES], below[DEGREES];
    if (!(fabs(a0) > moves_of(a, m) || b0 > moves_of(b, m))) {
        lose(y, m);
        return;
    }
    disc_scaled(above, a, b0, m);
    disc_sum(above, above, -a0, b, m);
    disc_scaled(below, a, a0, m);
    disc_sum(below, below, b0, b, m);
    disc_quotient(above, above, below, m);
    disc_atan(y, above, m);
    y[0] += atan2(a0, b0);
}

/* Half the difference (sign -1) or the sum of exp(u) and exp(-u). */
static void disc_hyperbola(double *y, const double *a, double sign, int m)
{
    double up[DEGREES], down[DEGREES];
    disc_exp(up, a, m);
    disc_scaled(down, a, -1, m);
    disc_exp(down, down, m);
    disc_sum(y, up, sign, down, m);
    disc_scaled(y, y, 0.5, m);
}

/* log(u + sqrt(u^2 + constant)): asinh and acosh. */
static void disc_area(double *y, const double *a, double constant, int m)
{
    double root[DEGREES];
    disc_product(root, a, a, m);
    disc_shifted(root, root, constant, m);
    disc_root(root, root, m);
    disc_sum(root, root, 1, a, m);
    disc_log(y, root, m);
}

static void disc_atanh(double *y, const double *a, int m)
{
    double above[DEGREES], below[DEGREES];
    disc_shifted(above, a, 1, m);
    disc_scaled(below, a, -1, m);
    disc_shifted(below, below, 1, m);
    disc_quotient(above, above, below, m);
    disc_log(y, above, m);
    disc_scaled(y, y, 0.5, m);
}

static void disc_tan(double *y, const double *a, int m)
{
    double above[DEGREES], below[DEGREES];
    disc_wave(above, a, m, 0);
    disc_wave(below, a, m, 1);
    disc_quotient(y, above, below, m);
}

static void disc_log1p(double *y, const double *a, int m)
{
    double shifted[DEGREES];
    disc_shifted(shifted, a, 1, m);
    disc_log(y, shifted, m);
}

static void disc_pow(double *y, const double *a, const double *b, int m)
{
    double exponent[DEGREES];
    disc_log(exponent, a, m);
    disc_product(exponent, b, exponent, m);
    disc_exp(y, exponent, m);
}

/* The operations that the graphs here have: others are left out. */
static void disc_of(double *y, int kind, const double *a, const double *b, double number, int m)
{
    UNUSED(a);
    UNUSED(b);
    UNUSED(number);
    switch (kind) {
    case OF_SUM: disc_sum(y, a, 1, b, m); break;
    case OF_DIFFERENCE: disc_sum(y, a, -1, b, m); break;
    case OF_SCALED: disc_scaled(y, a, number, m); break;
    case OF_SHIFTED: disc_shifted(y, a, number, m); break;
    case OF_PRODUCT: disc_product(y, a, b, m); break;
    case OF_QUOTIENT: disc_quotient(y, a, b, m); break;
    case OF_EXP: disc_exp(y, a, m); break;
    case OF_EXPM1: disc_exp(y, a, m); y[0] -= 1; break;
    case OF_SIN: disc_wave(y, a, m, 0); break;
    case OF_COS: disc_wave(y, a, m, 1); break;
    case OF_TAN: disc_tan(y, a, m); break;
    case OF_SINH: disc_hyperbola(y, a, -1, m); break;
    case OF_COSH: disc_hyperbola(y, a, 1, m); break;
    case OF_TANH: disc_tanh(y, a, m); break;
    case OF_SQRT: disc_root(y, a, m); break;
    case OF_HYPOT: disc_hypot(y, a, b, m); break;
    case OF_LOG: disc_log(y, a, m); break;
    case OF_LOG1P: disc_log1p(y, a, m); break;
    case OF_POWER: disc_power(y, a, number, m); break;
    case OF_POW: disc_pow(y, a, b, m); break;
    case OF_ATAN: disc_atan(y, a, m); break;
    case OF_ASIN: disc_asin(y, a, m); break;
    case OF_ACOS: disc_asin(y, a, m); disc_scaled(y, y, -1, m); y[0] += acos(0.0); break;
    case OF_ASINH: disc_area(y, a, 1, m); break;
    case OF_ACOSH: disc_area(y, a, -1, m); break;
    case OF_ATANH: disc_atanh(y, a, m); break;
    case OF_ERF: disc_erf(y, a, m); break;
    case OF_ATAN2: disc_angle(y, a, b, m); break;
    default: lose(y, m);
    }
}

/* The same on balls, the frequent ones at once. */
static void ball_of(double *y, int kind, const double *a, const double *b, double number)
{
    switch (kind) {
    case OF_SUM: y[0] = a[0] + b[0]; y[1] = a[1] + b[1]; break;
    case OF_DIFFERENCE: y[0] = a[0] - b[0]; y[1] = a[1] + b[1]; break;
    case OF_SCALED: y[0] = number*a[0]; y[1] = number != 0 ? fabs(number)*a[1] : 0; break;
    default: disc_of(y, kind, a, b, number, 0);
    }
}

static void copied(double *y, const double *a, int m) { memmove(y, a, (m + 2)*sizeof *y); }

static void number_on_disc(double *y, double value, int m)
{
    memset(y, 0, (m + 2)*sizeof *y);
    y[0] = value;
}

/* Numbers have their rows, at every degree. */
static void numbers_on_disc(model_pieces *s)
{
    for (int i = 0; i < NUMBERS_ON_DISC; i++)
        number_on_disc(ROW(disc_number_rows[i]), disc_numbers[i], MOST_ORDERS);
    for (int i = 0; i < GIVEN_ON_DISC; i++)
        number_on_disc(ROW(disc_given[2*i]), 0, MOST_ORDERS);
}

/* The first lines: rows of t, x and l are there; whole: with the coefficients of products that no other line reads. */
static void run_lines(model_pieces *s, int count, int m, int whole)
{
    for (int i = 0; i < GIVEN_ON_DISC; i++)
        ROW(disc_given[2*i])[0] = s->c[0][T + 1 + disc_given[2*i + 1]];
    for (int i = 0; i < count; i++) {
        const disc_line *line = &disc_lines[i];
        const double *a = ROW(line->a), *b = ROW(line->b);
        double *y = ROW(line->y);
        switch (line->kind) {
        case OF_CHOSEN: copied(y, s->at.choice[line->choice] > 0 ? a : b, m); break;
        case OF_EQUAL: copied(y, s->at.choice[line->choice] == 0 ? a : b, m); break;
        case OF_GUARDED:
            if (a[0] != 0)
                copied(y, b, m);
            else
                number_on_disc(y, 0, m);
            break;
        case OF_WHOLE: number_on_disc(y, s->at.choice[line->choice], m); break;
        case OF_NOT: number_on_disc(y, a[0] == 0, m); break;
        case OF_POSITIVE: number_on_disc(y, a[0] > 0, m); break;
        case OF_BOTH: number_on_disc(y, a[0] != 0 && b[0] != 0, m); break;
        case OF_EITHER: number_on_disc(y, a[0] != 0 || b[0] != 0, m); break;
        default:
            if (m && line->kind == OF_PRODUCT && line->last && !whole)
                y[REST] = rest_of_product(a, b, m);
            else if (m)
                disc_of(y, line->kind, a, b, line->number, m);
            else
                ball_of(y, line->kind, a, b, line->number);
        }
        if (s->rounded && m == 0)
            y[REST] += EPS*fabs(y[0]);
        if (!(y[REST] < INFINITY)) /* NaN too */
            y[REST] = INFINITY;
    }
}
