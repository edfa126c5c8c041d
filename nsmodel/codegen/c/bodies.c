/* ---- A step of many bodies: y_i = g_i + grad g_i d >= 0, d = h f + G' m, 0 <= m with y ---- */

struct model_solver;
typedef void model_function(const struct model_solver *, const double *t, const double *p, const double *a, const double *b, double *restrict);
typedef void model_own_function(const struct model_solver *, const double *t, const double *p, const double *a, double *restrict);

/* What a model is: its families of constraints, and the functions of their members' numbers. */
typedef struct {
    int families, record;               /* numbers of a body, its states first */
    const int *of_bodies, *item_size;   /* for each family: whether the second member is a body; numbers of an item, 0: none */
    model_function *const *row;         /* g, its gradient in the first state, and in the second where this is a body's */
    model_own_function *velocity, *leave;  /* leave: NULL where nobody does */
} model_functions;

/* Rows in use; each belongs to a family and has a first and perhaps a second member. */
typedef struct {
    int count, room;
    int *family, *first, *second;
    double *g;          /* value at the start of the step */
    double *slope;      /* (2 DIM) gradients in first and second; second: 0 unless a body */
    double *size;       /* |gradients| */
} model_rows;

typedef struct {
    double residual, gap, motion, cutoff;
    int worst_family, worst_first, worst_second;
    int rows, entered, groups, largest, factorisations, repeats;
    int by_active_set, by_interior, unsettled;
#if TIMES
    double search, assembly, solve;  /* CPU seconds */
#endif
} model_report;

typedef struct {
    const model_functions *model;
    double t, h, tolerance;
    int n;
    const double *q;               /* (n, DIM) */
    const unsigned char *present;  /* (n) */
    const double *velocity;        /* (n, DIM) f, where it is given from outside; else NULL */
    const double *numbers;         /* (n, NUMBERS) */
    const double *const *items;    /* for each family, its items' numbers */
    const int *item_count;
    const int *const *over;        /* for each family, the pairs it runs over (2 each), or NULL: all */
    const int *over_count;
    const double *farthest;        /* for each family the largest c of g = |q_i - q_j| - c; negative: another kind */
    const double *p;
    double motion;                 /* the largest |d_i| of the last step; 0: unknown */
    int contacts;                  /* of the last step: rows with m > 0 */
    const int *family, *first, *second;
    const double *multiplier;
    /* out */
    double *q_next;
    unsigned char *leaves;         /* (n) */
    int contacts_out;              /* as those of the last step; they lie in the memory given */
    int *family_out, *first_out, *second_out;
    double *multiplier_out;
} model_motion;

static double norm_of(const double *v)
{
    double sum = 0.0;
    int k;
    for (k = 0; k < DIM; k++) sum += v[k]*v[k];
    return sqrt(sum);
}

/* g and its gradients for a pair of records. */
static void evaluate(const model_motion *s, double t, int family, const double *one, const double *other, double *out)
{
    double time = t;
    memset(out, 0, (1 + 2*DIM)*sizeof *out);
    s->model->row[family](NULL, &time, s->p, one, other, out);
}

/* Take the row in where it may act, y >= g - |gradient| |d| < 0 is possible, or come near; 0 where it is not finite. */
static int consider(const model_motion *s, model_rows *rows, int family, int i, int j, const double *one, const double *other,
                    double motion, model_report *report)
{
    double out[1 + 2*DIM], first, second = 0.0;
    int k, finite = 1;
    evaluate(s, s->t + s->h, family, one, other, out);
    for (k = 0; k < 1 + 2*DIM; k++) finite = finite && isfinite(out[k]);
    if (!finite) {
        report->worst_family = family;
        report->worst_first = i;
        report->worst_second = j;
        return 0;
    }
    first = norm_of(out + 1);
    if (s->model->of_bodies[family]) second = norm_of(out + 1 + DIM);
    if (out[0] >= (first + second > 1.0 ? first + second : 1.0)*motion) return 1;
    if (rows->count < rows->room) {
        int r = rows->count;
        rows->family[r] = family;
        rows->first[r] = i;
        rows->second[r] = j;
        rows->g[r] = out[0];
        rows->size[r] = sqrt(first*first + second*second);
        memcpy(rows->slope + (size_t)2*DIM*r, out + 1, 2*DIM*sizeof(double));
        if (!s->model->of_bodies[family]) memset(rows->slope + (size_t)2*DIM*r + DIM, 0, DIM*sizeof(double));
    }
    rows->count++;
    return 1;
}

/* Pairs of present bodies no farther apart than `far`, by cells; each is considered once, i < j. */
static int search_pairs(const model_motion *s, model_rows *rows, int family, const double *records, double far, double motion,
                        model_arena *a, model_report *report)
{
    int n = s->n, i, k, e, count = 0, cells = 1, shape[3] = {1, 1, 1};
    double low[DIM], high[DIM], width = far;
    int *cell = TAKE(int, n), *start, *inside = TAKE(int, n);
    if (a->missing) return 1;
    for (i = 0; i < n; i++) {
        if (!s->present[i]) continue;
        for (k = 0; k < DIM; k++) {
            double x = s->q[(size_t)DIM*i + k];
            if (!count || x < low[k]) low[k] = x;
            if (!count || x > high[k]) high[k] = x;
        }
        count++;
    }
    if (count < 2) return 1;
    for (k = 0; k < DIM; k++)
        if (width < 1e-9*(high[k] - low[k])) width = 1e-9*(high[k] - low[k]);
    if (width < DBL_MIN) width = DBL_MIN;
    for (;;) {
        double product = 1.0;
        for (k = 0; k < DIM; k++) product *= floor((high[k] - low[k])/width) + 1.0;
        if (product <= 4.0*count + 64.0) break;
        width *= 1.5;
    }
    for (k = 0; k < DIM; k++) {
        shape[k] = (int)floor((high[k] - low[k])/width) + 1;
        cells *= shape[k];
    }
    start = TAKE(int, cells + 2);
    if (a->missing) return 1;
    memset(start, 0, (cells + 2)*sizeof *start);
    for (i = 0; i < n; i++) {
        int at = 0;
        if (!s->present[i]) continue;
        for (k = 0; k < DIM; k++) at = at*shape[k] + (int)floor((s->q[(size_t)DIM*i + k] - low[k])/width);
        cell[i] = at;
        start[at + 2]++;
    }
    for (i = 0; i < cells; i++) start[i + 2] += start[i + 1];
    for (i = 0; i < n; i++)
        if (s->present[i]) inside[start[cell[i] + 1]++] = i;
    for (i = 0; i < n; i++) {
        int from[3] = {0, 0, 0}, to[3] = {0, 0, 0}, place[3] = {0, 0, 0}, at, x, y, z;
        const double *q = s->q + (size_t)DIM*i;
        if (!s->present[i]) continue;
        for (at = cell[i], k = DIM - 1; k >= 0; at /= shape[k], k--) place[k] = at%shape[k];
        for (k = 0; k < DIM; k++) {
            from[k] = place[k] > 0 ? place[k] - 1 : 0;
            to[k] = place[k] + 1 < shape[k] ? place[k] + 1 : shape[k] - 1;
        }
        for (x = from[0]; x <= to[0]; x++)
            for (y = from[1]; y <= to[1]; y++)
                for (z = from[2]; z <= to[2]; z++) {
                    at = DIM == 1 ? x : DIM == 2 ? x*shape[1] + y : (x*shape[1] + y)*shape[2] + z;
                    for (e = start[at]; e < start[at + 1]; e++) {
                        int j = inside[e];
                        double distance = 0.0;
                        if (j <= i) continue;
                        for (k = 0; k < DIM; k++) {
                            double difference = s->q[(size_t)DIM*j + k] - q[k];
                            distance += difference*difference;
                        }
                        if (distance > far*far) continue;
                        if (!consider(s, rows, family, i, j, records + (size_t)s->model->record*i, records + (size_t)s->model->record*j, motion, report))
                            return 0;
                    }
                }
    }
    return 1;
}

/* All rows that may act when no body moves by more than `motion`; 0 where one is not finite. */
static int collect(const model_motion *s, model_rows *rows, const double *records, double motion, model_arena *a, model_report *report)
{
    int family, i, j;
    rows->count = 0;
    for (family = 0; family < s->model->families; family++) {
        if (s->over[family]) {
            const int *pair = s->over[family];
            for (i = 0; i < s->over_count[family]; i++, pair += 2) {
                const double *other = NULL;
                if (!s->present[pair[0]] || (s->model->of_bodies[family] && !s->present[pair[1]])) continue;
                if (s->model->of_bodies[family]) other = records + (size_t)s->model->record*pair[1];
                else if (pair[1] >= 0) other = s->items[family] + (size_t)s->model->item_size[family]*pair[1];
                if (!consider(s, rows, family, pair[0], pair[1], records + (size_t)s->model->record*pair[0], other, motion, report)) return 0;
            }
        } else if (s->model->of_bodies[family] && s->farthest[family] >= 0.0) {
            /* g = |q_i - q_j| - c_ij: with c_ij <= the largest c there is no row beyond that and 2 motion */
            char *kept = a->next;
            int fine = search_pairs(s, rows, family, records, s->farthest[family] + 2.0*motion, motion, a, report);
            a->next = kept;
            if (!fine) return 0;
        } else if (s->model->of_bodies[family]) {
            for (i = 0; i < s->n; i++)
                for (j = i + 1; j < s->n; j++)
                    if (s->present[i] && s->present[j] &&
                        !consider(s, rows, family, i, j, records + (size_t)s->model->record*i, records + (size_t)s->model->record*j, motion, report))
                        return 0;
        } else {
            int count = s->model->item_size[family] ? s->item_count[family] : 1;
            for (i = 0; i < s->n; i++)
                for (j = 0; s->present[i] && j < count; j++)
                    if (!consider(s, rows, family, i, s->model->item_size[family] ? j : -1, records + (size_t)s->model->record*i,
                                  s->model->item_size[family] ? s->items[family] + (size_t)s->model->item_size[family]*j : NULL, motion, report))
                        return 0;
        }
    }
    return 1;
}

static int root_of(int *parent, int i)
{
    while (parent[i] != i) i = parent[i] = parent[parent[i]];
    return i;
}

#define NEAR 0.5  /* a row enters where the forces of the last step leave it less than this times the largest speed */

#if TIMES
static double seconds(void) { return (double)clock()/CLOCKS_PER_SEC; }
#endif

/* The multiplier that a row had in the last step. */
static double last_of(const model_motion *s, const int *start, int family, int first, int second)
{
    int e;
    for (e = start[first]; e < start[first + 1]; e++)
        if (s->second[e] == second && s->family[e] == family) return s->multiplier[e];
    return 0.0;
}

/* One step; `memory` is for use in it alone: nothing is kept. On MODEL_NO_ROOM *missing says how much more is needed. */
#if !EXPORTED
static
#endif
int move_bodies(model_motion *s, char *memory, size_t size, size_t *missing, model_report *report)
{
    model_arena arena = {memory, memory + size, 0}, *a = &arena;
    int n = s->n, i, k, r, fresh, pass, attempt;
    double h = s->h, speed = 0.0, motion, moved = 0.0, wished = 0.0;
    double *records = TAKE(double, (size_t)s->model->record*n + 1), *f = TAKE(double, (size_t)DIM*n + 1), *w = TAKE(double, (size_t)DIM*n + 1);
    int *start = TAKE(int, n + 2), *parent = TAKE(int, n + 1), *local = TAKE(int, n + 1);
    double *m;
    char *after_fixed;
#if TIMES
    double clock_was = seconds();
#endif
    model_rows rows;
    memset(report, 0, sizeof *report);
    report->worst_family = -1;
    report->residual = INFINITY;
    if (a->missing) goto no_memory;
    for (i = 0; i < n; i++) {
        memcpy(records + (size_t)s->model->record*i, s->q + (size_t)DIM*i, DIM*sizeof(double));
        memcpy(records + (size_t)s->model->record*i + DIM, s->numbers + (size_t)(s->model->record - DIM)*i, (s->model->record - DIM)*sizeof(double));
    }
    for (i = 0; i < n; i++) {
        double *own = f + (size_t)DIM*i, size_i;
        memset(own, 0, DIM*sizeof *own);
        if (!s->present[i]) continue;
        if (s->velocity) memcpy(own, s->velocity + (size_t)DIM*i, DIM*sizeof *own);
        else {
            double time = s->t;
            s->model->velocity(NULL, &time, s->p, records + (size_t)s->model->record*i, own);
        }
        size_i = norm_of(own);
        if (!isfinite(size_i) || !isfinite(norm_of(s->q + (size_t)DIM*i))) {
            report->worst_first = i;
            return MODEL_NOT_FINITE;
        }
        if (size_i > speed) speed = size_i;
    }
    /* contacts of the last step, found by their first body (they are sorted by it) */
    memset(start, 0, (n + 2)*sizeof *start);
    for (i = 0; i < s->contacts; i++) start[s->first[i] + 1]++;
    for (i = 0; i < n; i++) start[i + 1] += start[i];
    motion = 2.0*(h*speed > s->motion ? h*speed : s->motion);
    after_fixed = a->next;
    for (attempt = 0; ; attempt++) {
        unsigned char *entered, *acts, *new_row;
        double *g, *b, unit, largest = 0.0;
        int *row_of_group, *of_group;
        a->next = after_fixed;
        report->repeats = attempt;
        /* 1. rows that may act */
        rows.room = 64 + s->contacts*2 + 4*n;
        for (;;) {
            char *mark = a->next;
            rows.family = TAKE(int, rows.room);
            rows.first = TAKE(int, rows.room);
            rows.second = TAKE(int, rows.room);
            rows.g = TAKE(double, rows.room);
            rows.size = TAKE(double, rows.room);
            rows.slope = TAKE(double, (size_t)2*DIM*rows.room);
            if (a->missing) goto no_memory;
            if (!collect(s, &rows, records, motion, a, report)) return MODEL_NOT_FINITE;
            if (a->missing) goto no_memory;
            if (rows.count <= rows.room) break;
            rows.room = rows.count;
            a->next = mark;
        }
        report->rows = rows.count;
#if TIMES
        report->search += seconds() - clock_was;
        clock_was = seconds();
#endif
        /* 2. in units of the largest speed: u = d/(h unit), rows of length 1 */
        entered = TAKE(unsigned char, rows.count + 1);
        acts = TAKE(unsigned char, rows.count + 1);
        m = TAKE(double, rows.count + 1);
        new_row = TAKE(unsigned char, rows.count + 1);
        b = TAKE(double, rows.count + 1);
        g = TAKE(double, (size_t)2*DIM*rows.count + 1);
        row_of_group = TAKE(int, rows.count + 1);
        of_group = TAKE(int, rows.count + 1);
        if (a->missing) goto no_memory;
        unit = speed;
        for (r = 0; r < rows.count; r++) {
            const double *slope = rows.slope + (size_t)2*DIM*r, *one = f + (size_t)DIM*rows.first[r];
            double drift = 0.0, scale = rows.size[r] > 0.0 ? 1.0/rows.size[r] : 0.0;
            for (k = 0; k < DIM; k++) drift += slope[k]*one[k];
            if (s->model->of_bodies[rows.family[r]])
                for (k = 0; k < DIM; k++) drift += slope[DIM + k]*f[(size_t)DIM*rows.second[r] + k];
            for (k = 0; k < 2*DIM; k++) g[(size_t)2*DIM*r + k] = scale*slope[k];
            b[r] = scale*(rows.g[r]/h + drift);
            if (rows.size[r] == 0.0) b[r] = rows.g[r] < 0.0 ? -1.0 : 1.0;
            if (-b[r] > unit) unit = -b[r];
        }
        if (!(unit > 0.0)) unit = 1.0;
        memset(w, 0, (size_t)DIM*n*sizeof *w);
        for (r = 0; r < rows.count; r++) {
            double last = last_of(s, start, rows.family[r], rows.first[r], rows.second[r]);
            b[r] /= unit;
            m[r] = last*rows.size[r]/(h*unit);
            acts[r] = m[r] > 0.0;
            if (acts[r]) {
                for (k = 0; k < DIM; k++) w[(size_t)DIM*rows.first[r] + k] += g[(size_t)2*DIM*r + k]*m[r];
                if (s->model->of_bodies[rows.family[r]])
                    for (k = 0; k < DIM; k++) w[(size_t)DIM*rows.second[r] + k] += g[(size_t)2*DIM*r + DIM + k]*m[r];
            }
        }
        fresh = 0;
        for (r = 0; r < rows.count; r++) {
            double left = b[r];
            for (k = 0; k < DIM; k++) left += g[(size_t)2*DIM*r + k]*w[(size_t)DIM*rows.first[r] + k];
            if (s->model->of_bodies[rows.family[r]])
                for (k = 0; k < DIM; k++) left += g[(size_t)2*DIM*r + DIM + k]*w[(size_t)DIM*rows.second[r] + k];
            entered[r] = b[r] < 0.0 || acts[r] || (s->contacts && left < NEAR);
            fresh += entered[r];
            new_row[r] = entered[r];
            if (!s->contacts && b[r] < 0.0) acts[r] = 1;
        }
        memset(w, 0, (size_t)DIM*n*sizeof *w);
#if TIMES
        report->assembly += seconds() - clock_was;
        clock_was = seconds();
#endif
        /* 3. groups of rows that have entered; rows that the solution violates enter; until there is none */
        for (pass = 0; fresh; pass++) {
            char *mark = a->next;
            int *first, *second, *bodies, *offset, *waiting, *body_offset, groups = 0, group;
            double *gx, *gb, *gm, *gw, *gg;
            unsigned char *gacts, *stale;
            for (i = 0; i < n; i++) parent[i] = i;
            for (r = 0; r < rows.count; r++)
                if (entered[r] && s->model->of_bodies[rows.family[r]]) {
                    int one = root_of(parent, rows.first[r]), other = root_of(parent, rows.second[r]);
                    if (one < other) parent[other] = one;
                    else parent[one] = other;
                }
            for (i = 0; i < n; i++) local[i] = -1;
            for (r = 0; r < rows.count; r++)
                if (entered[r]) {
                    i = root_of(parent, rows.first[r]);
                    if (local[i] < 0) local[i] = groups++;
                }
            offset = TAKE(int, groups + 2);
            waiting = TAKE(int, groups + 2);
            body_offset = TAKE(int, groups + 2);
            stale = TAKE(unsigned char, groups + 1);
            bodies = TAKE(int, n + 1);
            first = TAKE(int, rows.count + 1);
            second = TAKE(int, rows.count + 1);
            gx = TAKE(double, (size_t)DIM*n + 1);
            gw = TAKE(double, (size_t)DIM*n + 1);
            gg = TAKE(double, (size_t)2*DIM*rows.count + 1);
            gb = TAKE(double, rows.count + 1);
            gm = TAKE(double, rows.count + 1);
            gacts = TAKE(unsigned char, rows.count + 1);
            if (a->missing) goto no_memory;
            memset(offset, 0, (groups + 2)*sizeof *offset);
            memset(waiting, 0, (groups + 2)*sizeof *waiting);
            memset(body_offset, 0, (groups + 2)*sizeof *body_offset);
            memset(stale, 0, groups + 1);
            for (r = 0; r < rows.count; r++) {
                group = local[root_of(parent, rows.first[r])];
                if (group < 0 || (!entered[r] && s->model->of_bodies[rows.family[r]] && local[root_of(parent, rows.second[r])] != group)) {
                    of_group[r] = -1;
                    continue;
                }
                of_group[r] = group;
                offset[group + 2]++;
                waiting[group] += !entered[r];
                if (new_row[r]) stale[group] = 1;
            }
            for (i = 0; i < n; i++) {
                group = local[root_of(parent, i)];
                if (group >= 0) body_offset[group + 2]++;
            }
            for (group = 0; group < groups; group++) {
                offset[group + 2] += offset[group + 1];
                body_offset[group + 2] += body_offset[group + 1];
            }
            for (r = 0; r < rows.count; r++)
                if (entered[r]) row_of_group[offset[of_group[r] + 1]++] = r;
            for (r = 0; r < rows.count; r++)
                if (!entered[r] && of_group[r] >= 0) row_of_group[offset[of_group[r] + 1]++] = r;
            for (i = 0; i < n; i++) {
                group = local[root_of(parent, i)];
                if (group >= 0) bodies[body_offset[group + 1]++] = i;
            }
            report->groups = groups;
            report->largest = 0;
            /* local numbers of bodies: their place in their group */
            {
                int *number = TAKE(int, n + 1);
                if (a->missing) goto no_memory;
                for (group = 0; group < groups; group++)
                    for (i = body_offset[group]; i < body_offset[group + 1]; i++) number[bodies[i]] = i - body_offset[group];
                for (group = 0; group < groups; group++) {
                    char *inner = a->next;
                    model_group p;
                    int from = body_offset[group], at = offset[group], how;
                    memset(&p, 0, sizeof p);
                    p.n = body_offset[group + 1] - from;
                    p.most = offset[group + 1] - at;
                    p.m = p.most - waiting[group];
                    p.row = row_of_group + at;
                    if (p.n > report->largest) report->largest = p.n;
                    if (!stale[group]) continue;
                    for (i = 0; i < p.n; i++)
                        memcpy(gx + (size_t)DIM*i, s->q + (size_t)DIM*bodies[from + i], DIM*sizeof(double));
                    for (i = 0; i < p.most; i++) {
                        r = p.row[i];
                        first[i] = number[rows.first[r]];
                        second[i] = s->model->of_bodies[rows.family[r]] ? number[rows.second[r]] : -1;
                        memcpy(gg + (size_t)2*DIM*i, g + (size_t)2*DIM*r, 2*DIM*sizeof(double));
                        gb[i] = b[r];
                        gm[i] = m[r];
                        gacts[i] = acts[r];
                    }
                    p.x = gx; p.w = gw; p.first = first; p.second = second; p.g = gg; p.b = gb; p.multiplier = gm; p.acts = gacts;
                    p.close = pass > 0;
                    how = solve_group(&p, a);
                    if (how < 0) goto no_memory;
                    report->factorisations += p.factorisations;
                    report->by_active_set += how == 1;
                    report->by_interior += how == 2 || how == 3;
                    report->unsettled += how == 4;
                    for (i = 0; i < p.n; i++)
                        memcpy(w + (size_t)DIM*bodies[from + i], gw + (size_t)DIM*i, DIM*sizeof(double));
                    for (i = 0; i < p.m; i++) {
                        r = p.row[i];
                        m[r] = gm[i];
                        acts[r] = gacts[i];
                        entered[r] = 1;
                    }
                    a->next = inner;
                }
            }
            a->next = mark;
            fresh = 0;
            for (r = 0; r < rows.count; r++) {
                double left = b[r];
                new_row[r] = 0;
                if (entered[r]) continue;
                for (k = 0; k < DIM; k++) left += g[(size_t)2*DIM*r + k]*w[(size_t)DIM*rows.first[r] + k];
                if (s->model->of_bodies[rows.family[r]])
                    for (k = 0; k < DIM; k++) left += g[(size_t)2*DIM*r + DIM + k]*w[(size_t)DIM*rows.second[r] + k];
                if (left >= -WRONG) continue;
                entered[r] = acts[r] = new_row[r] = 1;
                fresh++;
            }
        }
#if TIMES
        report->solve += seconds() - clock_was;
        clock_was = seconds();
#endif
        /* 4. the motion, and whether it was within the bound */
        moved = wished = 0.0;
        for (i = 0; i < n; i++) {
            double d[DIM], size_i;
            if (!s->present[i]) {
                for (k = 0; k < DIM; k++) s->q_next[(size_t)DIM*i + k] = s->q[(size_t)DIM*i + k];
                continue;
            }
            for (k = 0; k < DIM; k++) {
                d[k] = h*(f[(size_t)DIM*i + k] + unit*w[(size_t)DIM*i + k]);
                s->q_next[(size_t)DIM*i + k] = s->q[(size_t)DIM*i + k] + d[k];
            }
            size_i = norm_of(d);
            moved += size_i*size_i;
            if (!(size_i <= largest)) largest = size_i;
            wished += h*h*norm_of(f + (size_t)DIM*i)*norm_of(f + (size_t)DIM*i);
        }
        if (!isfinite(largest)) return MODEL_NOT_SOLVED;
        report->motion = largest;
        report->cutoff = motion;
        if (largest > motion && attempt < 20) {
            motion = 1.5*largest;
            continue;
        }
        if (largest > motion) return MODEL_NOT_SOLVED;
        /* 5. the certificate, from the definition */
        {
            double *e = TAKE(double, (size_t)DIM*n + 1), worst = 0.0, gap = 0.0, noise = 0.0, reached = largest > h*speed ? largest : h*speed, far = 0.0;
            double round_off;
            if (a->missing) goto no_memory;
            for (i = 0; i < n; i++)
                for (k = 0; k < DIM; k++) {
                    size_t at = (size_t)DIM*i + k;
                    e[at] = s->present[i] ? s->q_next[at] - s->q[at] - h*f[at] : 0.0;
                    if (s->present[i] && fabs(s->q[at]) > far) far = fabs(s->q[at]);
                }
            round_off = 16.0*DBL_EPSILON*(far + reached);
            if (reached < round_off/s->tolerance) reached = round_off/s->tolerance;
            for (r = 0; r < rows.count; r++) {
                const double *slope = rows.slope + (size_t)2*DIM*r;
                double value = rows.g[r], size_r = rows.size[r], l = size_r > 0.0 ? m[r]*h*unit/size_r : 0.0, bad, small;
                if (!entered[r]) l = 0.0;
                for (k = 0; k < DIM; k++) {
                    size_t at = (size_t)DIM*rows.first[r] + k;
                    value += slope[k]*(s->q_next[at] - s->q[at]);
                    e[at] -= slope[k]*l;
                }
                if (s->model->of_bodies[rows.family[r]])
                    for (k = 0; k < DIM; k++) {
                        size_t at = (size_t)DIM*rows.second[r] + k;
                        value += slope[DIM + k]*(s->q_next[at] - s->q[at]);
                        e[at] -= slope[DIM + k]*l;
                    }
                m[r] = l;
                if (!(size_r > 0.0)) size_r = 1.0;
                bad = -value/size_r;
                small = fabs(value)/size_r < l*size_r ? fabs(value)/size_r : l*size_r;
                if (small > bad) bad = small;
                if (!(bad <= worst)) {
                    worst = bad;
                    report->worst_family = rows.family[r];
                    report->worst_first = rows.first[r];
                    report->worst_second = rows.second[r];
                }
                gap += l*fabs(value);
                noise += l*(fabs(rows.g[r]) + size_r*(reached + far));
            }
            for (i = 0; i < n*DIM; i++)
                if (!(fabs(e[i]) <= worst)) worst = fabs(e[i]);
            worst /= reached > 0.0 ? reached : 1.0;
            if (gap > 16.0*DBL_EPSILON*noise && gap > worst*(moved + wished)) worst = gap/(moved + wished);
            report->residual = worst;
        }
        break;
    }
    if (!(report->residual <= s->tolerance)) return MODEL_NOT_SOLVED;
    /* 6. the gaps at the new positions; the contacts, sorted by their first body; who leaves */
    report->gap = INFINITY;
    for (i = 0; i < n; i++) memcpy(records + (size_t)s->model->record*i, s->q_next + (size_t)DIM*i, DIM*sizeof(double));
    memset(start, 0, (n + 2)*sizeof *start);
    for (r = 0; r < rows.count; r++) {
        double out[1 + 2*DIM];
        const double *other = NULL;
        int family = rows.family[r], second = rows.second[r];
        if (s->model->of_bodies[family]) other = records + (size_t)s->model->record*second;
        else if (second >= 0) other = s->items[family] + (size_t)s->model->item_size[family]*second;
        evaluate(s, s->t + h, family, records + (size_t)s->model->record*rows.first[r], other, out);
        if (!(out[0] >= report->gap)) report->gap = out[0];
        if (m[r] > 0.0) start[rows.first[r] + 2]++;
    }
    for (i = 0; i < n; i++) start[i + 2] += start[i + 1];
    s->contacts_out = start[n + 1];
    s->family_out = TAKE(int, start[n + 1] + 1);
    s->first_out = TAKE(int, start[n + 1] + 1);
    s->second_out = TAKE(int, start[n + 1] + 1);
    s->multiplier_out = TAKE(double, start[n + 1] + 1);
    if (a->missing) goto no_memory;
    for (r = 0; r < rows.count; r++)
        if (m[r] > 0.0) {
            int at = start[rows.first[r] + 1]++;
            s->family_out[at] = rows.family[r];
            s->first_out[at] = rows.first[r];
            s->second_out[at] = rows.second[r];
            s->multiplier_out[at] = m[r];
        }
    for (i = 0; i < n; i++) {
        double time = s->t + h, value = 0.0;
        if (s->present[i] && s->model->leave) s->model->leave(NULL, &time, s->p, records + (size_t)s->model->record*i, &value);
        s->leaves[i] = value > 0.0;
    }
#if TIMES
    report->assembly += seconds() - clock_was;
#endif
    return MODEL_OK;
no_memory:
    *missing = a->missing;
    return MODEL_NO_ROOM;
}
