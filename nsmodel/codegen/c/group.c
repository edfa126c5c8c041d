/* ---- A group of bodies that touch: min |w|^2/2 subject to y = G w + b >= 0, that is w = G' m, 0 <= m with y >= 0, m y = 0 ---- */

/* In units in which the rows of G and the w wanted are of order 1. */
typedef struct {
    int n, m;
    int most;                     /* rows m ... most - 1 wait: they enter where w comes near to violating them */
    const double *x;              /* (n, DIM) positions: the order of elimination */
    int *row;                     /* (most) the rows' numbers outside */
    int *first, *second;          /* (most) bodies of a row; second < 0: none */
    double *g;                    /* (most, 2 DIM) gradients in first and second */
    double *b;                    /* (most) */
    double *multiplier;           /* (most) in: a guess; out: m */
    double *w;                    /* (n, DIM) */
    unsigned char *acts;          /* (most) rows with y = 0 */
    int *slot;
    double *slack, *ds, *dm, *theta, *value, *kept, *along, *safe, *rhs, *dw, *ordered;
    model_ldl factor;
    char *behind;                 /* the memory from the factor on */
    int close;                    /* the guess solves the group but for some new rows */
    int factorisations;
    long work, budget;            /* linear systems factored or solved so far in the step, and at most */
    int exhausted;                /* one more was wanted */
} model_group;

/* The larger, or NaN where one of them is: what is judged forgets nothing. */
static double worse_of(double a, double b) { return a > b || a != a ? a : b; }

/* The row i of G w. */
static double row_of(const model_group *p, const double *w, int i)
{
    const double *g = p->g + (ptrdiff_t)2*DIM*i, *one = w + (ptrdiff_t)DIM*p->first[i];
    double y = 0.0;
    int k;
    for (k = 0; k < DIM; k++) y += g[k]*one[k];
    if (p->second[i] >= 0) {
        const double *other = w + (ptrdiff_t)DIM*p->second[i];
        for (k = 0; k < DIM; k++) y += g[DIM + k]*other[k];
    }
    return y;
}

/* out := out + G' m */
static void add_transposed(const model_group *p, const double *m, double *out)
{
    int i, k;
    for (i = 0; i < p->m; i++) {
        const double *g = p->g + (ptrdiff_t)2*DIM*i;
        double *one = out + (ptrdiff_t)DIM*p->first[i];
        if (m[i] == 0.0) continue;
        for (k = 0; k < DIM; k++) one[k] += g[k]*m[i];
        if (p->second[i] >= 0) {
            double *other = out + (ptrdiff_t)DIM*p->second[i];
            for (k = 0; k < DIM; k++) other[k] += g[DIM + k]*m[i];
        }
    }
}

/* w := G' m */
static void set_w(model_group *p)
{
    ZERO(p->w, (ptrdiff_t)DIM*p->n);
    add_transposed(p, p->multiplier, p->w);
}

/* One more linear system; 0 where there may be none. */
static int spend(model_group *p)
{
    p->exhausted |= p->work >= p->budget;
    p->work += !p->exhausted;
    return !p->exhausted;
}

/* The factor of the rows that have entered, where the one before was; 0: no memory. */
static int prepare_factor(model_group *p, model_arena *a)
{
    a->next = p->behind;
    return prepare_ldl(&p->factor, p->n, p->x, p->m, p->first, p->second, p->slot, a);
}

/* Factor I + G' diag(theta) G; 0 where there is no more work to spend. */
static int factor_group(model_group *p)
{
    model_ldl *f = &p->factor;
    const double *theta = p->theta;
    int i, r, s, n = p->n;
    if (!spend(p)) return 0;
    p->factorisations++;
    ZERO(f->a, (ptrdiff_t)BLOCK*f->up[n]);
    ZERO(f->diagonal, (ptrdiff_t)BLOCK*n);
    for (i = 0; i < n; i++)
        for (r = 0; r < DIM; r++) f->diagonal[(ptrdiff_t)BLOCK*i + r*DIM + r] = 1.0;
    for (i = 0; i < p->m; i++) {
        const double *g = p->g + (ptrdiff_t)2*DIM*i, *h = g + DIM;
        double *own;
        if (theta[i] == 0.0) continue;
        own = f->diagonal + (ptrdiff_t)BLOCK*f->place[p->first[i]];
        for (r = 0; r < DIM; r++)
            for (s = 0; s < DIM; s++) own[r*DIM + s] += theta[i]*g[r]*g[s];
        if (p->second[i] >= 0) {
            int one = f->place[p->first[i]], other = f->place[p->second[i]];
            double *off = f->a + (ptrdiff_t)BLOCK*p->slot[i];
            own = f->diagonal + (ptrdiff_t)BLOCK*other;
            for (r = 0; r < DIM; r++)
                for (s = 0; s < DIM; s++) {
                    own[r*DIM + s] += theta[i]*h[r]*h[s];
                    off[r*DIM + s] += theta[i]*(one < other ? g[r]*h[s] : h[r]*g[s]);
                }
        }
    }
    factor_ldl(f);
    return 1;
}

/* dw := (I + G' Theta G)^-1 rhs; 0 where there is no more work to spend. */
static int solve_for_dw(model_group *p)
{
    int i, k;
    if (!spend(p)) return 0;
    for (i = 0; i < p->n; i++)
        for (k = 0; k < DIM; k++) p->ordered[(ptrdiff_t)DIM*p->factor.place[i] + k] = p->rhs[(ptrdiff_t)DIM*i + k];
    solve_ldl(&p->factor, p->ordered);
    for (i = 0; i < p->n; i++)
        for (k = 0; k < DIM; k++) p->dw[(ptrdiff_t)DIM*i + k] = p->ordered[(ptrdiff_t)DIM*p->factor.place[i] + k];
    return 1;
}

#define STIFF 1e6       /* weight of the rows that act in the preconditioner */
#define SETTLED 1e-13   /* a row that acts is at 0 to this */
#define WRONG 1e-11     /* a multiplier or a row below minus this changes the index set */
#define ROUGH 1e-6      /* the same while the index set changes */
#define PROXIMAL 2      /* proximal steps on an index set */
#define SOFT 1e3        /* weight of the rows in the augmented Lagrangian, to begin with */
#define OUTER 40        /* updates of the multipliers, */
#define INNER 60        /* Newton steps for each, */
#define FLAT 1e-12      /* to a gradient of so much beside the largest multiplier */
#define REFINED 24      /* conjugate gradients on an index set, at most, */
#define AFRESH 8        /* begun anew after so many, */
#define AWAY 100.0      /* up to so many times the least remainder so far */
#define EXACTER 0.1     /* part of ROUGH to which a row that acts is at 0 while the index set changes */
#define FEWEST 4        /* changes of the index set that need not become fewer */
#define STIFFER 10.0    /* factor by which the rows' weight in the augmented Lagrangian grows */
#define HALVINGS 40     /* in a line search */

/* out := (G G' + 1/STIFF)^-1 r on the rows that act, as STIFF (r - G dw) with (I + STIFF G' G) dw = STIFF G' r; 0 where there is no more
 * work to spend. */
static int precondition(model_group *p, const double *r, double *out)
{
    int i;
    ZERO(p->rhs, (ptrdiff_t)DIM*p->n);
    for (i = 0; i < p->m; i++) out[i] = STIFF*r[i];
    add_transposed(p, out, p->rhs);
    if (!solve_for_dw(p)) return 0;
    for (i = 0; i < p->m; i++) out[i] = p->acts[i] ? out[i] - STIFF*row_of(p, p->dw, i) : 0.0;
    return 1;
}

/* r := -y on the rows that act, else 0, w from the multipliers; the largest |r| */
static double remainder_of(model_group *p, double *r)
{
    double worst = 0.0;
    int i;
    set_w(p);
    for (i = 0; i < p->m; i++) {
        r[i] = p->acts[i] ? -(row_of(p, p->w, i) + p->b[i]) : 0.0;
        worst = worse_of(worst, fabs(r[i]));
    }
    return worst;
}

/* y = 0 on the rows that act to `fine`, G G' dm = -y: proximal steps, which also do where rows depend on each other and
 * contradict, then conjugate gradients where these help. The rows that act are factored. */
static void equalise(model_group *p, double fine)
{
    double *r = p->value, *z = p->ds, *d = p->dm, *q = p->along;
    double rz = 0.0, worst = 0.0, least;
    int i, k;
    for (k = 0; k < PROXIMAL; k++) {
        worst = remainder_of(p, r);
        if (worst <= fine || !precondition(p, r, z)) return;
        for (i = 0; i < p->m; i++) p->multiplier[i] += z[i];
    }
    least = worst = remainder_of(p, r);
    COPY(p->safe, p->multiplier, p->m);
    for (k = 0; k < REFINED && worst > fine && worst < AWAY*least; k++) {
        double before = rz, along = 0.0;
        if (!precondition(p, r, z)) break;
        for (i = 0, rz = 0.0; i < p->m; i++) rz += r[i]*z[i];
        for (i = 0; i < p->m; i++) d[i] = k%AFRESH ? z[i] + rz/before*d[i] : z[i];
        ZERO(p->rhs, (ptrdiff_t)DIM*p->n);
        add_transposed(p, d, p->rhs);
        for (i = 0; i < p->m; i++) {
            q[i] = p->acts[i] ? row_of(p, p->rhs, i) : 0.0;
            along += d[i]*q[i];
        }
        if (!(along > 0.0)) break;
        for (i = 0; i < p->m; i++) p->multiplier[i] += rz/along*d[i];
        worst = k%AFRESH == AFRESH - 1 ? remainder_of(p, r) : 0.0;
        for (i = 0; i < p->m && k%AFRESH < AFRESH - 1; i++) {
            r[i] -= rz/along*q[i];
            worst = worse_of(worst, fabs(r[i]));
        }
        if (worst < least) {
            least = worst;
            COPY(p->safe, p->multiplier, p->m);
        }
    }
    COPY(p->multiplier, p->safe, p->m);
    set_w(p);
}

/* Solve on the rows that act, roughly, and to the end where no sign is wrong; change the rows of the wrong sign; how many, more
 * than there are where there is no more work to spend. */
static int solve_and_change(model_group *p)
{
    int i, pass, wrong = 0;
    for (i = 0; i < p->m; i++) p->theta[i] = p->acts[i] ? STIFF : 0.0;
    if (!factor_group(p)) return p->m + 1;
    for (pass = 0; pass < 2 && !wrong; pass++) {
        double bound = pass ? WRONG : ROUGH;
        equalise(p, pass ? SETTLED : EXACTER*ROUGH);
        for (i = 0; i < p->m; i++) {
            if ((p->acts[i] ? p->multiplier[i] : row_of(p, p->w, i) + p->b[i]) >= -bound) continue;
            if (p->acts[i]) p->multiplier[i] = 0.0;
            p->acts[i] = !p->acts[i];
            wrong++;
        }
    }
    return p->exhausted ? p->m + 1 : wrong;
}

/* The multipliers are an answer up to round-off: none is negative. */
static int accept(model_group *p)
{
    int i;
    for (i = 0; i < p->m; i++)
        if (!p->acts[i] || p->multiplier[i] < 0.0) p->multiplier[i] = 0.0;
    set_w(p);
    return 1;
}

/* Primal-dual active set: solve on the rows that act, change those of the wrong sign, until none is; 0 where they become more
 * than before, or more than `most` at first. */
static int settle(model_group *p, int rounds, int most)
{
    int i, round;
    for (i = 0; i < p->m; i++)
        if (!p->acts[i]) p->multiplier[i] = 0.0;
    for (round = 0; round < rounds; round++) {
        int wrong = solve_and_change(p);
        if (!wrong) return accept(p);
        if (wrong > most) return 0;
        most = wrong > FEWEST ? wrong : FEWEST;
    }
    return 0;
}

/* The slope along dw, at w + t dw, of |w|^2/2 + c/2 sum max(0, m/c - (G w + b))^2: value = m - c (G w + b), ds = G dw */
static double slope_at(const model_group *p, double c, double t, double linear, double square)
{
    double slope = linear + t*square;
    int i;
    for (i = 0; i < p->m; i++) {
        double pull = p->value[i] - t*c*p->ds[i];
        if (pull > 0.0) slope -= pull*p->ds[i];
    }
    return slope;
}

/* Augmented Lagrangian from the multipliers kept: minimise over w by Newton's method with an exact line search, which converges
 * from anywhere, take the pulls max(0, m - c (G w + b)) for multipliers, until the rows that pull are those that act. */
static int augmented(model_group *p)
{
    double c = SOFT;
    int i, k, outer, inner, n = DIM*p->n;
    for (outer = 0; outer < OUTER; outer++, c = c < STIFF ? STIFFER*c : c) {
        COPY(p->multiplier, p->kept, p->m);
        for (inner = 0; inner < INNER; inner++) {
            double worst = 0.0, linear = 0.0, square = 0.0, low = 0.0, step = 1.0, size = 1.0;
            for (i = 0; i < p->m; i++) {
                p->value[i] = p->multiplier[i] - c*(row_of(p, p->w, i) + p->b[i]);
                p->acts[i] = p->value[i] > 0.0;
                p->theta[i] = p->acts[i] ? c : 0.0;
                p->kept[i] = p->acts[i] ? p->value[i] : 0.0;
                if (p->kept[i] > size) size = p->kept[i];
            }
            for (i = 0; i < n; i++) p->rhs[i] = -p->w[i];
            add_transposed(p, p->kept, p->rhs);
            for (i = 0; i < n; i++)
                worst = worse_of(worst, fabs(p->rhs[i]));
            if (worst <= FLAT*size) break;
            if (!factor_group(p) || !solve_for_dw(p)) return 0;
            for (i = 0; i < p->m; i++) p->ds[i] = row_of(p, p->dw, i);
            for (i = 0; i < n; i++) {
                linear += p->w[i]*p->dw[i];
                square += p->dw[i]*p->dw[i];
            }
            if (slope_at(p, c, 1.0, linear, square) > 0.0) {
                double high = 1.0;
                for (k = 0; k < HALVINGS; k++) {
                    step = 0.5*(low + high);
                    if (slope_at(p, c, step, linear, square) > 0.0) high = step;
                    else low = step;
                }
            }
            for (i = 0; i < n; i++) p->w[i] += step*p->dw[i];
        }
        COPY(p->multiplier, p->kept, p->m);
        if (!solve_and_change(p)) return accept(p);
        COPY(p->multiplier, p->kept, p->m);
        set_w(p);
    }
    return 0;
}

/* The largest step in [0, 1] that keeps v + step dv >= 0. */
static double room(const double *v, const double *dv, int m)
{
    double step = 1.0;
    int i;
    for (i = 0; i < m; i++)
        if (v[i] + step*dv[i] < 0.0) step = -v[i]/dv[i];
    return step;
}

/* dw from (I + G' Theta G) dw = -w + G' dm; 0 where there is no more work to spend. */
static int step_of_newton(model_group *p)
{
    int i;
    for (i = 0; i < DIM*p->n; i++) p->rhs[i] = -p->w[i];
    add_transposed(p, p->dm, p->rhs);
    return solve_for_dw(p);
}

#define SWAP(type, one, other) do { type swapped = one; one = other; other = swapped; } while (0)

/* Let the waiting rows enter that w leaves less than `near`; how many. */
static int enter(model_group *p, double near)
{
    int i, k, before = p->m;
    for (i = p->m; i < p->most; i++) {
        int to = p->m;
        if (row_of(p, p->w, i) + p->b[i] >= near) continue;
        SWAP(int, p->row[i], p->row[to]);
        SWAP(int, p->first[i], p->first[to]);
        SWAP(int, p->second[i], p->second[to]);
        SWAP(double, p->b[i], p->b[to]);
        SWAP(double, p->multiplier[i], p->multiplier[to]);
        SWAP(unsigned char, p->acts[i], p->acts[to]);
        for (k = 0; k < 2*DIM; k++) SWAP(double, p->g[(ptrdiff_t)2*DIM*i + k], p->g[(ptrdiff_t)2*DIM*to + k]);
        p->m++;
    }
    return p->m - before;
}

#define LOOKS 2        /* at rows that wait: */
#define LOOK_BELOW {2.0, 1e-2}  /* mu from which on one is taken, */
#define ENTER_BELOW {0.5, 0.05} /* and values below which they enter */
#define FRESH 0.3      /* slack of a row that enters, at least, or the root of mu */
#define SHORT 0.1      /* a step below this is followed by one to the centre */
#define STALLED 8      /* iterations that may fail to halve mu near the end, */
#define NEAR_END 1e-4  /* which is below this mu */
#define BACK 0.995     /* part of the way to the boundary that is gone */
#define STEEPEST 1e13  /* largest weight of a row in the normal equations */

/* Interior point (Mehrotra's predictor and corrector): w = G' m, G w + b = s, m s = mu, until mu <= target; 0 where it is not
 * reached, -1: no memory. On its way, from `look` on, rows that wait may enter. */
static int interior(model_group *p, double target, int most, int look, model_arena *a)
{
    static const double looks[LOOKS] = LOOK_BELOW, nears[LOOKS] = ENTER_BELOW;
    int i, k, m = p->m, n = DIM*p->n, stalled = 0;
    double *s = p->slack, *u = p->multiplier, least = INFINITY, reached = 1.0;
    for (k = 0; k < most; k++) {
        double mu = 0.0, infeasible = 0.0, after = 0.0, aim, step, other;
        for (i = 0; i < m; i++) {
            mu += s[i]*u[i]/m;
            p->value[i] = row_of(p, p->w, i) + p->b[i] - s[i];
            infeasible = worse_of(infeasible, fabs(p->value[i]));
        }
        if (!isfinite(mu + infeasible)) return 0;
        if (mu <= target && infeasible <= sqrt(target)) return 1;
        if (look < LOOKS && mu < looks[look] && infeasible < 1.0 && p->m < p->most) {
            int entered = enter(p, nears[look++]);
            double fresh = mu < FRESH*FRESH ? sqrt(mu) : FRESH;
            for (i = m; i < p->m; i++) {
                double y = row_of(p, p->w, i) + p->b[i];
                s[i] = y > fresh ? y : fresh;
                u[i] = mu/s[i];
            }
            m = p->m;
            set_w(p);
            for (i = 0; i < m; i++) p->value[i] = row_of(p, p->w, i) + p->b[i] - s[i];
            if (entered && !prepare_factor(p, a)) return -1;
        }
        if (mu < 0.5*least) {
            least = mu;
            stalled = 0;
        } else if (++stalled > STALLED && mu < NEAR_END) return 0;
        for (i = 0; i < m; i++) {
            p->theta[i] = u[i]/s[i];
            if (!(p->theta[i] < STEEPEST)) p->theta[i] = STEEPEST;
            p->dm[i] = -p->theta[i]*p->value[i];
        }
        if (!factor_group(p) || !step_of_newton(p)) return 0;
        for (i = 0; i < m; i++) {
            p->ds[i] = row_of(p, p->dw, i) + p->value[i];
            p->dm[i] = -p->theta[i]*p->ds[i] - u[i];
        }
        step = room(s, p->ds, m);
        other = room(u, p->dm, m);
        for (i = 0; i < m; i++) after += (s[i] + step*p->ds[i])*(u[i] + other*p->dm[i])/m;
        aim = reached < SHORT ? mu : mu*(after/mu)*(after/mu)*(after/mu); /* after a short step: back to the centre */
        for (i = 0; i < m; i++) {
            p->ds[i] = (aim - (reached < SHORT ? 0.0 : p->ds[i]*p->dm[i]))/s[i];
            p->dm[i] = p->ds[i] - p->theta[i]*p->value[i];
        }
        if (!step_of_newton(p)) return 0;
        for (i = 0; i < m; i++) {
            double corrected = p->ds[i];
            p->ds[i] = row_of(p, p->dw, i) + p->value[i];
            p->dm[i] = corrected - p->theta[i]*p->ds[i] - u[i];
        }
        step = room(s, p->ds, m);
        other = room(u, p->dm, m);
        reached = step = BACK*(other < step ? other : step);
        for (i = 0; i < m; i++) {
            s[i] += step*p->ds[i];
            u[i] += step*p->dm[i];
        }
        for (i = 0; i < n; i++) p->w[i] += step*p->dw[i];
    }
    return 0;
}

#define SMALL 64        /* rows up to which the active set is tried first whatever has changed */
#define START 1.0     /* slacks and multipliers that the interior point starts from, at least, */
#define CLOSE 0.03     /* and where all but some new rows are solved */
#define FEW 12          /* changes up to which it is tried first in larger groups */
#define ROUNDS_SMALL 12 /* of the active set in small groups, */
#define ROUNDS_FIRST 6  /* in larger ones, */
#define ROUNDS_AFTER 8  /* and after the interior point, */
#define ITERATIONS 60   /* which takes up to so many, */
#define TARGETS {1e-6, 1e-8} /* to one mean of multipliers times slacks, then to the other */

/* What has solved a group; UNSETTLED: as far as all ways get, and the certificate decides. */
enum { BY_ACTIVE_SET = 1, BY_INTERIOR, BY_LAGRANGIAN, UNSETTLED };

/* Solve a group whose rows that act and multipliers are guessed: by the active set alone, by the interior point and the active
 * set, by both and the augmented Lagrangian; -1: no memory. */
static int solve_group(model_group *p, model_arena *a)
{
    static const double targets[] = TARGETS;
    double inside = p->close ? CLOSE : START;
    int i, k, m = p->m, n = p->n, doubtful = 0;
    p->slot = TAKE(int, p->most);
    p->slack = TAKE(double, p->most);
    p->ds = TAKE(double, p->most);
    p->dm = TAKE(double, p->most);
    p->theta = TAKE(double, p->most);
    p->value = TAKE(double, p->most);
    p->kept = TAKE(double, p->most);
    p->along = TAKE(double, p->most);
    p->safe = TAKE(double, p->most);
    p->rhs = TAKE(double, (ptrdiff_t)DIM*n);
    p->dw = TAKE(double, (ptrdiff_t)DIM*n);
    p->ordered = TAKE(double, (ptrdiff_t)DIM*n);
    p->behind = a->next;
    if (a->full || !prepare_factor(p, a)) return -1;
    for (i = 0; i < m; i++) {
        if (!p->acts[i]) p->multiplier[i] = 0.0;
        p->kept[i] = p->multiplier[i];
    }
    set_w(p);
    for (i = 0; i < m; i++) doubtful += !p->acts[i] && row_of(p, p->w, i) + p->b[i] < -WRONG;
    if ((m <= SMALL || doubtful <= FEW || p->close) && settle(p, m <= SMALL ? ROUNDS_SMALL : ROUNDS_FIRST, m <= SMALL || p->close ? m : FEW))
        return BY_ACTIVE_SET;
    for (i = 0; i < m; i++) p->multiplier[i] = p->kept[i] > inside ? p->kept[i] : inside;
    set_w(p);
    for (i = 0; i < m; i++) {
        double y = row_of(p, p->w, i) + p->b[i];
        p->slack[i] = y > inside ? y : inside;
    }
    for (k = 0; k < 2; k++) {
        if (interior(p, targets[k], ITERATIONS, k > 0 ? LOOKS : 0, a) < 0) return -1;
        m = p->m;
        for (i = 0; i < m; i++) {
            p->acts[i] = p->multiplier[i] > p->slack[i];
            p->kept[i] = p->multiplier[i];
        }
        if (p->exhausted) return UNSETTLED;
        if (settle(p, ROUNDS_AFTER, m)) return BY_INTERIOR;
        COPY(p->multiplier, p->kept, m);
        set_w(p);
    }
    for (i = 0; i < m; i++)
        if (!(p->kept[i] > p->slack[i])) p->kept[i] = 0.0;
    COPY(p->multiplier, p->kept, m);
    set_w(p);
    return augmented(p) ? BY_LAGRANGIAN : UNSETTLED;
}
