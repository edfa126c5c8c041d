/* Conditions of a mode, their first roots, and the mode after an event: event_driven/modes.py, bernstein.py, event_location.py. */

enum { NOBODY, OF_Y, OF_L };
enum { OPEN = 1, TURNS, CROSSED }; /* of a switch: to be turned when all are known; no l acts on it, and its side is proved */
enum { SIDE, EQUAL, FLOOR, CEIL, TOWARD_ZERO, NEAREST };

/* sign * column + shift >= 0 for switch of: a row, or M + a branch; its code is after beyond. */
typedef struct {
    int of, column, orders, acts;
    double sign, shift, after;
} condition;

/* The conditions of a switch; how many, 2 at most. */
static int conditions_of(const model_pieces *s, int of, int orders, condition *out)
{
#if LAW
    const int known = HOW.through ? orders - 1 : orders;
    if (of < M) {
        const int code = s->at.codes[of];
        int count = 0;
        if (code) {
            out[0] = (condition){of, Y + of, HOW.feeds ? known : orders, OF_Y, -code, 0, 0};
            return lower[of] < upper[of];
        }
        if (is_finite(lower[of]))
            out[count++] = (condition){of, L + of, known, OF_L, 1, -lower[of], -1};
        if (is_finite(upper[of]))
            out[count++] = (condition){of, L + of, known, OF_L, -1, upper[of], 1};
        return count;
    }
#endif
#if SWITCHED
    const int b = of - M, column = branch_column[b];
    const double choice = s->at.choice[b];
    double low = choice, high = choice + 1;
    switch (branch_kind[b]) {
    case SIDE:
    case EQUAL:
        out[0] = (condition){of, column, orders, NOBODY, choice, 0, -choice};
        return choice != 0;
    case CEIL:
        low = choice - 1;
        high = choice;
        break;
    case TOWARD_ZERO:
        low = choice - (choice <= 0);
        high = choice + (choice >= 0);
        break;
    case NEAREST:
        low = choice - 0.5;
        high = choice + 0.5;
    }
    out[0] = (condition){of, column, orders, NOBODY, 1, -low, choice - 1};
    out[1] = (condition){of, column, orders, NOBODY, -1, high, choice + 1};
    return 2;
#else
    UNUSED(s);
    UNUSED(of);
    UNUSED(orders);
    UNUSED(out);
    return 0;
#endif
}

static void coefficients(const model_pieces *s, const condition *of, double *c)
{
    for (int k = 0; k <= of->orders; k++)
        c[k] = of->sign > 0 ? s->c[k][of->column] : -s->c[k][of->column];
    c[0] += of->shift;
}

static double size_of(const model_pieces *s, const condition *of)
{
#if LAW
    if (of->acts == OF_Y)
        return size_y(s, of->of);
    if (of->acts == OF_L)
        return size_l(s, of->of);
#endif
    return max_of(fabs(of->shift), s->at.size_switches[of->of - M]);
}

static int is_same(const condition *a, const condition *b) { return a->of == b->of && a->after == b->after; }

static double largest_of(int n, const double *c)
{
    double most = 0;
    for (int k = 0; k < n; k++)
        most = max_of(most, fabs(c[k]));
    return most;
}

/* A share of the unit of time in which the later half of orders is not larger than the first, or than a size. */
static double shrunk(int n, const double *c, double size, double share)
{
    const int last = n < ORDERS + 1 ? n : ORDERS + 1;
    for (int pass = 0; pass < PACES; pass++) {
        double largest = size, factor = 1, raised = share, own[ORDERS + 1];
        for (int k = 1; k < last; k++) {
            own[k] = fabs(c[k])*raised;
            raised *= share;
        }
        for (int k = 1; k <= HALF_ORDERS && k < last; k++)
            largest = max_of(largest, own[k]);
        for (int k = HALF_ORDERS + 1; k < last; k++)
            if (own[k] > largest && largest > 0)
                factor = min_of(factor, pow(largest/own[k], 1.0/k));
        share *= factor;
        if (factor > HALVED)
            break;
    }
    return share;
}

/* By how much the unit of time is to shrink for a column not to grow from order to order; one that begins beyond HALF_ORDERS does not. */
static double pace_of(const model_pieces *s, int column, double size, double rounding, double share)
{
    double first = size, later = 0;
    if (share == 1) {
        int below = 1;
        for (int k = HALF_ORDERS + 1; k <= ORDERS; k++)
            below &= fabs(s->c[k][column]) <= size;
        if (below)
            return share;
    }
    for (int k = 1; k <= ORDERS; k++)
        if (k <= HALF_ORDERS)
            first = max_of(first, fabs(s->c[k][column]));
        else
            later = max_of(later, fabs(s->c[k][column]));
    if ((share == 1 && later <= first) || first <= rounding)
        return share;
    double own[ORDERS + 1];
    for (int k = 0; k <= ORDERS; k++)
        own[k] = s->c[k][column];
    return shrunk(ORDERS + 1, own, size, share);
}

/* The share of the unit of time in which coefficients of x and l do not grow from order to order: germs are looked at in it. */
static double pace(const model_pieces *s)
{
    double share = 1, pushed[N];
    pushes(s, pushed);
    for (int i = 0; i < N; i++)
        share = pace_of(s, i, s->at.size_x[i], TERM_ROUNDING*pushed[i], share);
#if LAW
    for (int i = 0; i < M; i++)
        share = pace_of(s, L + i, s->at.size_l[i], -1, share);
#endif
    return share;
}

/* The order of the first coefficient that is not rounding, of those that decide a germ; -1 where all of them are. */
static int leading(int n, const double *c, double least, double share)
{
    const int decide = n < ORDERS + 1 ? n : ORDERS + 1, half = decide < HALF_ORDERS + 1 ? decide : HALF_ORDERS + 1;
    double own[ORDERS + 1], raised = 1, largest = 0;
    if (largest_of(decide - half, c + half) > largest_of(half, c)) { /* the condition itself needs a shorter one */
        const double shorter = shrunk(n, c, fabs(c[0]), share);
        double most = 0;
        for (int k = 0; k < half; k++, raised *= shorter)
            most = max_of(most, fabs(c[k])*raised);
        share = most > least ? shorter : share;
        raised = 1;
    }
    for (int k = 0; k < decide; k++) {
        own[k] = fabs(c[k])*raised;
        largest = max_of(largest, own[k]);
        raised *= share;
    }
    least = max_of(least, GERM*largest);
    for (int k = 0; k < decide; k++)
        if (own[k] > least)
            return k;
    return -1;
}

/* The share of the unit of time, 1 at most, in which no later coefficient is larger than that of order k. */
static double share_of_order(int n, const double *c, int k)
{
    const double size = fabs(c[k]);
    double share = 1;
    for (int j = k + 1; j < n; j++)
        if (fabs(c[j]) > size)
            share = min_of(share, pow(size/fabs(c[j]), 1.0/(j - k)));
    return share;
}

/* The same by rounding alone: the first order above least in a unit of time in which later ones are no larger. */
static int lowest(int n, const double *c, double least)
{
    const int decide = n < ORDERS + 1 ? n : ORDERS + 1;
    for (int k = 0; k < decide; k++)
        if (fabs(c[k])*pow(share_of_order(decide, c, k), k) > least)
            return k;
    return -1;
}

/* The value of a polynomial of n coefficients. */
static double value_of(int n, const double *c, double s)
{
    double total = 0;
    for (int k = n - 1; k >= 0; k--)
        total = total*s + c[k];
    return total;
}

static double slope_of(int n, const double *c, double s)
{
    double total = 0;
    for (int k = n - 1; k > 0; k--)
        total = total*s + k*c[k];
    return total;
}

/* The root between c(low) > 0 > c(high): Newton's method from s, kept inside by halving. */
static double simple_root(int n, const double *c, double low, double high, double s)
{
    for (int iteration = 0; iteration < ITERATIONS; iteration++) {
        double v = 0, d = 0;
        for (int k = n - 1; k >= 0; k--) {
            d = d*s + v;
            v = v*s + c[k];
        }
        if (v == 0)
            return s;
        if (v > 0)
            low = s;
        else
            high = s;
        double next = d != 0 ? s - v/d : low;
        if (!(low < next && next < high))
            next = (low + high)/2;
        if (fabs(next - s) <= EXACT*high)
            return next;
        s = next;
    }
    return s;
}

/* The first root in (low, low + width] of a polynomial with the coefficients b in Bernstein's basis there; NONE where there is none. */
static double first_in(model_pieces *s, int n, const double *c, const double *b, double low, double width)
{
    int changes = 0, last = 0;
    if (b[0] <= 0 && low > 0)
        return low;
    for (int j = 0; j < n; j++)
        if (b[j] != 0) {
            const int sign = b[j] > 0 ? 1 : -1;
            changes += last ? sign != last : b[0] == 0 && sign < 0;
            last = sign;
        }
    if (last == 0 || changes == 0)
        return b[n - 1] == 0 ? low + width : NONE;
    if (changes == 1 && b[0] > 0 && b[n - 1] < 0) { /* the coefficients, as a polygon, are 0 near the root */
        int j = 1;
        while (b[j] >= 0)
            j++;
        return simple_root(n, c, low, low + width, low + width*((j - 1 + b[j - 1]/(b[j - 1] - b[j]))/(n - 1)));
    }
    if (changes == 1 && b[0] > 0 && b[n - 1] == 0)
        return low + width;
    if (width < NARROW || !spend_on(s))
        return low;
    double left[MOST_ORDERS + 1], right[MOST_ORDERS + 1];
    memcpy(right, b, n*sizeof *b);
    for (int j = 0; j < n; j++) {
        left[j] = right[0];
        for (int k = 0; k < n - 1 - j; k++)
            right[k] = (right[k] + right[k + 1])/2;
    }
    const double at = first_in(s, n, c, left, low, width/2);
    return at <= 1 ? at : first_in(s, n, c, right, low + width/2, width/2);
}

/* The first root in (0, 1] of sum c_k s^k, c_0 >= 0; NONE where it is positive on (0, 1]. */
static double first_root(model_pieces *s, int n, const double *c)
{
    double b[MOST_ORDERS + 1], sum = 0, binomial = 1;
    for (int k = 1; k < n; k++)
        sum += fabs(c[k]);
    if (c[0] > sum)
        return NONE;
    for (int k = 0; k < n; k++) { /* b_j = sum_k comb(j, k)/comb(n - 1, k) c_k */
        b[k] = c[k]/binomial;
        binomial = binomial*(n - 1 - k)/(k + 1);
    }
    for (int r = 1; r < n; r++)
        for (int j = n - 1; j >= r; j--)
            b[j] += b[j - 1];
    return first_in(s, n, c, b, 0, 1);
}

static int expand_finite(model_pieces *s, int orders);
static double tie_of(model_pieces *s, const condition *of, double share);

/* Give a switch another code. */
static void turn(model_pieces *s, int of, double code)
{
    if (of < M)
        s->at.codes[of] = (signed char)code;
    else
        s->at.choice[of - M] = code;
}

#if LAW
/* The first end of row i that is finite: -1 or 1; 0 where none is. */
static int end_of(const model_pieces *s, int i) 
{
    UNUSED(s);
    return is_finite(lower[i]) ? -1 : is_finite(upper[i]) ? 1 : 0;
}

/* Leave a singular mode: one of its open rows goes to an end, the one that its rate leads to. */
static int let_go(model_pieces *s)
{
    for (int i = 0; i < M; i++)
        if (s->at.open[i] && s->at.codes[i] == 0 && end_of(s, i)) {
            const double rate = s->c[1][Y + i];
            s->at.codes[i] = rate > 0 && is_finite(lower[i]) ? -1 : rate < 0 && is_finite(upper[i]) ? 1 : end_of(s, i);
            return 1;
        }
    return 0;
}

/* Whether a row that only its rate can hold at 0 is not there: beside its size, and how far x moves it. */
static int is_apart(const model_pieces *s, int i)
{
    const double y = s->c[0][Y + i];
    double motion[N];
    if (y == 0)
        return 0;
    for (int j = 0; j < N; j++)
        motion[j] = fabs(s->c[1][j]);
    return fabs(y) > AT_ZERO*max_of(size_y(s, i), terms_of_x(s, i, motion));
}

/* The rows that are apart go to an end: how many; -1: there is no such end. */
static int let_apart(model_pieces *s)
{
    int count = 0;
    if (!HOW.through)
        return 0;
    for (int a = 0; a < HOW.n; a++) {
        const int i = HOW.active[a];
        const double y = s->c[0][Y + i];
        if (!is_apart(s, i))
            continue;
        s->at.open[i] = 1;
        s->at.codes[i] = y > 0 ? -1 : 1;
        if (!is_finite(y > 0 ? lower[i] : upper[i]))
            return -1;
        count++;
    }
    return count;
}
#endif

static int has_numbers(const model_pieces *s)
{
    for (int k = 0; k <= ORDERS; k++) {
        for (int i = 0; i < N; i++)
            if (s->c[k][i] != s->c[k][i] || (k == 1 && !is_finite(s->c[k][i])))
                return 0;
        for (int i = 0; i < M; i++) /* one that no x depends on yet */
            if (s->c[k][Y + i] != s->c[k][Y + i])
                return 0;
    }
    return 1;
}

/* A mark of the mode, by which those that were tried are known. */
static unsigned long long mark_of(const model_pieces *s)
{
    unsigned long long mark = FNV_BASIS;
    for (int i = 0; i < M; i++)
        mark = (mark ^ (unsigned)(s->at.codes[i] + 2))*FNV_PRIME;
    for (int b = 0; b < CHOICES; b++) {
        unsigned long long bits;
        memcpy(&bits, &s->at.choice[b], sizeof bits);
        mark = (mark ^ bits)*FNV_PRIME;
    }
    return mark;
}

/*
 * Whether a condition does not hold just after the start: of those that are open or whose multipliers may have moved. Where l or
 * what a branch chooses jumps, y and arguments may jump too: of the others those that are clearly broken.
 */
static int is_wrong(model_pieces *s, const condition *of, double share)
{
    double c[MOST_ORDERS + 1];
    if (s->at.open[of->of] == CROSSED)
        return 0;
    coefficients(s, of, c);
    if (!s->at.open[of->of] && of->acts != OF_L)
        return c[0] < 0 && c[0] < -TIE*size_of(s, of);
    int first = leading(of->orders + 1, c, TIE*size_of(s, of), share);
    if (first != 1 && of->acts != OF_L)
        first = leading(of->orders + 1, c, tie_of(s, of, TIE), share);
    return first >= 0 && c[first] < 0;
}

#if SWITCHED
/* Leave open the switches whose argument jumps with what others choose, and does not move, where their side is not its own. */
static int follow_others(model_pieces *s)
{
    int any = 0;
    for (int b = 0; b < CHOICES; b++) {
        const int column = branch_column[b], kind = branch_kind[b];
        const double argument = s->c[0][column], side = (argument > 0) - (argument < 0);
        int still = branch_nested[b] && (kind == SIDE || kind == EQUAL);
        for (int k = 1; still && k <= ORDERS; k++)
            still = s->c[k][column] == 0;
        if (!still || s->at.choice[b] == (side == 0 && kind == SIDE ? 1 : side))
            continue;
        s->at.choice[b] = NAN;
        any = 1;
    }
    return any;
}

#endif
/* The germs of the mode at the place, whose comparisons of comparisons follow these; 0 where it has none. */
static int expand_germs(model_pieces *s)
{
    int found = expand(s, ORDERS);
#if SWITCHED
    for (int tried = 0; tried < CHOICES && found && follow_others(s); tried++)
        found = expand(s, ORDERS);
#endif
    return found && has_numbers(s);
}

/* The mode in which all germs are valid, by principal pivoting; 0 where it does not settle. */
static int pivot(model_pieces *s)
{
    unsigned long long seen[PIVOTS];
    int one = 0, count = 0;
    condition all[2];
    for (int iteration = 0; iteration < PIVOTS; iteration++) {
        int any = 0;
        if (!expand_germs(s)) {
#if LAW
            if (let_go(s))
                continue;
#endif
            return 0;
        }
#if LAW
        const int apart = let_apart(s);
        if (apart < 0)
            return 0;
        if (apart)
            continue;
#endif
        const unsigned long long mark = mark_of(s);
        int known = iteration >= TOGETHER;
        for (int i = 0; i < count; i++)
            known |= seen[i] == mark;
        one |= known;
        const double share = pace(s);
        for (int of = 0; of < M + CHOICES; of++)
            for (int n = conditions_of(s, of, ORDERS, all), i = 0; i < n; i++) {
                if ((any && one) || !is_wrong(s, &all[i], share))
                    continue;
                any = 1;
                s->at.open[of] = TURNS;
                s->turns[of] = all[i].after;
            }
        if (!any)
            return 1;
        for (int of = 0; of < M + CHOICES; of++)
            if (s->at.open[of] == TURNS) {
                s->at.open[of] = OPEN;
                turn(s, of, s->turns[of]);
            }
        seen[count++] = mark;
    }
    return 0;
}

/* Whether all germs are valid in the mode at the place. */
static int is_valid(model_pieces *s)
{
    condition all[2];
    if (!expand_germs(s))
        return 0;
#if LAW
    for (int a = 0; HOW.through && a < HOW.n; a++)
        if (is_apart(s, HOW.active[a]))
            return 0;
#endif
    const double share = pace(s);
    for (int of = 0; of < M + CHOICES; of++)
        for (int n = conditions_of(s, of, ORDERS, all), i = 0; i < n; i++)
            if (is_wrong(s, &all[i], share))
                return 0;
    return 1;
}

/* The codes that a switch may have, but those that y refuses: where no l acts on it directly, it has its sign in all modes. */
static int codes_of(const model_pieces *s, int of, double *codes)
{
    int count = 0;
    if (s->at.open[of] == CROSSED) {
        codes[0] = of < M ? s->at.codes[of] : s->at.choice[of - M];
        return 1;
    }
#if LAW
    if (of < M) {
        const double y = s->c[0][Y + of];
        const int clear = !feeds[of] && fabs(y) > NONZERO_SHARE*size_y(s, of);
        if (!clear)
            codes[count++] = 0;
        if (is_finite(lower[of]) && !(clear && y <= 0))
            codes[count++] = -1;
        if (is_finite(upper[of]) && !(clear && y >= 0))
            codes[count++] = 1;
        return count;
    }
#endif
#if SWITCHED
    const double choice = s->at.choice[of - M];
    const int two = branch_kind[of - M] == SIDE || branch_kind[of - M] == EQUAL;
    codes[count++] = two ? -1 : choice;
    codes[count++] = two ? 1 : choice - 1;
    if (!two)
        codes[count++] = choice + 1;
#else
    UNUSED(s);
    UNUSED(of);
    UNUSED(codes);
#endif
    return count;
}

/* Whether the x of the mode at the place and that of germs go the same way; pushed: of these. */
static int agrees(const model_pieces *s, double (*germs)[N], const double *pushed, double share)
{
    double own[N];
    pushes(s, own);
    for (int i = 0; i < N; i++) {
        double most = 0, apart = 0, raised = 1;
        for (int k = 0; k <= ORDERS; k++) {
            const double a = germs[k][i]*raised, b = s->c[k][i]*raised;
            most = max_of(most, max_of(fabs(a), fabs(b)));
            apart = max_of(apart, fabs(a - b));
            raised *= share;
        }
        if (apart > APART*most + TIE*(s->at.size_x[i] + max_of(own[i], pushed[i])))
            return 0;
    }
    return 1;
}

/* The open switches, FEW at most, the codes that each may have, and which of these it has: a counter with so many digits. */
typedef struct {
    int n, open[FEW], counts[FEW], digits[FEW];
    double codes[FEW][MOST_CODES];
} modes;

static int list_modes(const model_pieces *s, modes *all)
{
    int any = 1;
    memset(all, 0, sizeof *all);
    for (int of = 0; of < M + CHOICES; of++)
        if (s->at.open[of]) {
            all->open[all->n] = of;
            all->counts[all->n] = codes_of(s, of, all->codes[all->n]);
            any &= all->counts[all->n++] > 0;
        }
    return any;
}

/* Turn the switches as the digits say; whether that is a mode of these codes. */
static int turn_all(model_pieces *s, const modes *all, const double *codes)
{
    int same = 1;
    for (int i = 0; i < all->n; i++) {
        same &= all->codes[i][all->digits[i]] == codes[i];
        turn(s, all->open[i], all->codes[i][all->digits[i]]);
    }
    return same;
}

/* Count on; 0 at the end. */
static int next_mode(modes *all)
{
    for (int i = all->n - 1; i >= 0; i--) {
        if (++all->digits[i] < all->counts[i])
            return 1;
        all->digits[i] = 0;
    }
    return 0;
}

static int count_open(const model_pieces *s, int from, int to)
{
    int count = 0;
    for (int of = from; of < to; of++)
        count += s->at.open[of] != 0;
    return count;
}

enum { THE_ONLY_ONE, AGREED, NOT_DECIDED, SPLIT }; /* What is known of the mode: the first three are counted. */

/* Whether g or h has a product of two l that the mode holds: Newton's method finds one of its l, or none. */
static int holds_coupled_rows(const model_pieces *s)
{
#if LINEAR
    UNUSED(s);
#else
    for (int i = 0; i < M; i++)
        for (int j = 0; j < M; j++)
            if (coupled[i*M + j] && s->at.codes[i] == 0 && s->at.codes[j] == 0)
                return 1;
#endif
    return 0;
}

/*
 * Whether all valid modes of the open switches have the x of the one at the place, of which the series are there; it is not decided
 * where one of them holds coupled rows. After this order 0 alone.
 */
static int compare_modes(model_pieces *s)
{
    modes all;
    double now[FEW] = {0}, pushed[N], first[COLUMNS];
    const double own = pace(s);
    int verdict = holds_coupled_rows(s) ? NOT_DECIDED : AGREED;
    if (!list_modes(s, &all))
        return verdict;
    for (int i = 0; i < all.n; i++)
        now[i] = all.open[i] < M ? s->at.codes[all.open[i]] : s->at.choice[all.open[i] - M];
    memcpy(first, s->c[0], sizeof first);
    for (int k = 0; k <= ORDERS; k++)
        memcpy(s->germs[k], s->c[k], sizeof s->germs[k]);
    pushes(s, pushed);
    do {
        const int same = turn_all(s, &all, now);
        if (holds_coupled_rows(s))
            verdict = NOT_DECIDED;
        if (!same && is_valid(s) && !agrees(s, s->germs, pushed, min_of(own, pace(s))))
            verdict = SPLIT;
    } while (verdict != SPLIT && next_mode(&all));
    for (int i = 0; i < all.n; i++)
        turn(s, all.open[i], now[i]);
    memcpy(s->c[0], first, sizeof first);
#if LAW
    memcpy(s->at.l, first + L, M*sizeof *first);
#if SLOPES
    slopes_here(s);
#endif
#endif
    return verdict;
}

/* The mode that the place goes on in, by pivoting from the codes that stand or from guesses, else of all; 0 where none is found. */
static int settle_mode(model_pieces *s)
{
    modes all;
    const model_place begun = s->at;
    if (pivot(s))
        return 1;
#if GUESSED
    if (pivot_from_guesses(s, &begun))
        return 1;
#endif
    s->at = begun;
    if (count_open(s, 0, M + CHOICES) > FEW)
        return 0;
    if (!list_modes(s, &all))
        return 0;
    do {
        turn_all(s, &all, all.codes[0]);
        if (is_valid(s))
            return 1;
    } while (next_mode(&all));
    return 0;
}

/* Move the place, back where times < 0, by so many times what rounding leaves open of the time, or of the fastest state. */
static void creep(model_pieces *s, double times)
{
    double rates[N], fastest = INFINITY;
    for (int i = 0; i < N; i++) {
        rates[i] = is_finite(s->c[1][i]) ? s->c[1][i]/s->at.tau : 0;
        if (rates[i] != 0 && s->at.x[i] != 0)
            fastest = min_of(fastest, fabs(s->at.x[i]/rates[i]));
    }
    const double t = fabs(s->at.t), time = times*EPS*max_of(t, fastest < INFINITY ? min_of(fastest, MOST_CREEP*t) : 0);
    s->at.t += time;
    for (int i = 0; i < N; i++)
        s->at.x[i] += rates[i]*time;
}

/* Move x from where it was to the time of the place at the rates there, which stand: some may not have been known before. */
static void creep_along(model_pieces *s, double t, const double *x)
{
    for (int i = 0; i < N; i++)
        s->at.x[i] = x[i] + s->c[1][i]/s->at.tau*(s->at.t - t);
}

/* The same; where the mode that is taken up has no number at the place, a little later, as well as time is known. */
static int choose_mode(model_pieces *s)
{
    if (!CHOICES)
        return settle_mode(s);
    const model_place begun = s->at;
    double t = begun.t, x[N];
    memcpy(x, begun.x, sizeof x);
    for (int i = 0; i < LATER; i++) {
        if (settle_mode(s)) {
            if (t == begun.t)
                return 1;
            creep_along(s, begun.t, begun.x);
            return expand_germs(s);
        }
        s->at = begun;
        s->at.t = t;
        memcpy(s->at.x, x, sizeof x);
        if (expand_germs(s))
            break;
        creep(s, ldexp(1, i));
        t = s->at.t;
        memcpy(x, s->at.x, sizeof x);
    }
    s->at = begun;
    return 0;
}
