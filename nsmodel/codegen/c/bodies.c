/* ---- A step of many bodies: y_i = g_i + grad g_i d >= 0, d = h f + G' m, 0 <= m with y ---- */

struct model_solver;
typedef void model_function(const struct model_solver *, const double *t, const double *p, const double *a, const double *b,
                            double *restrict);
typedef void model_own_function(const struct model_solver *, const double *t, const double *p, const double *a,
                                double *restrict);

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

@REPORT@

@MOTION@

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
    ZERO(out, 1 + 2*DIM);
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
    first = norm_of(out + 1);
    if (s->model->of_bodies[family]) second = norm_of(out + 1 + DIM);
    if (!finite || !isfinite(first) || !isfinite(second)) {
        report->worst_family = family;
        report->worst_first = i;
        report->worst_second = j;
        return 0;
    }
    if (out[0] >= (first + second > 1.0 ? first + second : 1.0)*motion) return 1;
    if (rows->count < rows->room) {
        int r = rows->count;
        rows->family[r] = family;
        rows->first[r] = i;
        rows->second[r] = j;
        rows->g[r] = out[0];
        rows->size[r] = sqrt(first*first + second*second);
        COPY(rows->slope + (ptrdiff_t)2*DIM*r, out + 1, 2*DIM);
        if (!s->model->of_bodies[family]) ZERO(rows->slope + (ptrdiff_t)2*DIM*r + DIM, DIM);
    }
    rows->count++;
    return 1;
}

#define NARROWEST 1e-9 /* width of a cell, beside what all span, */
#define CELLS_EACH 4.0 /* and the most cells: so many for each body, */
#define CELLS_MORE 64.0 /* and so many more; */
#define COARSER 1.5 /* factor by which cells are made wider until they are as few */
#define SIZES 12 /* sizes of bodies that are searched apart, each class up to twice as large as the one before */

/* Pairs of a body of one kind of size and one of another, or of the same, no farther apart than their sizes, by cells. */
static int search_between(const model_motion *s, model_rows *rows, int family, const double *records, const double *size,
                          const signed char *kind, int small, int large, double far, double motion, model_arena *a,
                          model_report *report)
{
    int n = s->n, i, k, e, count = 0, cells = 1, shape[3] = {1, 1, 1};
    const ptrdiff_t record = s->model->record;
    double low[DIM], high[DIM], width = far;
    int *cell = TAKE(int, n), *start, *inside = TAKE(int, n);
    if (a->full) return 1;
    for (i = 0; i < n; i++) {
        if (kind[i] != small) continue;
        for (k = 0; k < DIM; k++) {
            double x = s->q[(ptrdiff_t)DIM*i + k];
            if (!count || x < low[k]) low[k] = x;
            if (!count || x > high[k]) high[k] = x;
        }
        count++;
    }
    for (k = 0; k < DIM; k++)
        if (width < NARROWEST*(high[k] - low[k])) width = NARROWEST*(high[k] - low[k]);
    if (width < DBL_MIN) width = DBL_MIN;
    for (;;) {
        double product = 1.0;
        for (k = 0; k < DIM; k++) product *= floor((high[k] - low[k])/width) + 1.0;
        if (product <= CELLS_EACH*count + CELLS_MORE) break;
        width *= COARSER;
    }
    for (k = 0; k < DIM; k++) {
        shape[k] = (int)floor((high[k] - low[k])/width) + 1;
        cells *= shape[k];
    }
    start = TAKE(int, cells + 2);
    if (a->full) return 1;
    ZERO(start, cells + 2);
    for (i = 0; i < n; i++) {
        int at = 0;
        if (kind[i] != small) continue;
        for (k = 0; k < DIM; k++) at = at*shape[k] + (int)floor((s->q[(ptrdiff_t)DIM*i + k] - low[k])/width);
        cell[i] = at;
        start[at + 2]++;
    }
    for (i = 0; i < cells; i++) start[i + 2] += start[i + 1];
    for (i = 0; i < n; i++)
        if (kind[i] == small) inside[start[cell[i] + 1]++] = i;
    for (i = 0; i < n; i++) {
        int from[3] = {0, 0, 0}, to[3] = {0, 0, 0}, at, x, y, z;
        const double *q = s->q + (ptrdiff_t)DIM*i;
        if (kind[i] != large) continue;
        for (k = 0; k < DIM; k++) {
            double place = floor((q[k] - low[k])/width);
            from[k] = place > 1.0 ? place < shape[k] + 2.0 ? (int)place - 1 : shape[k] : 0;
            to[k] = place + 1.0 < shape[k] ? place > -3.0 ? (int)place + 1 : -1 : shape[k] - 1;
        }
        for (x = from[0]; x <= to[0]; x++)
            for (y = from[1]; y <= to[1]; y++)
                for (z = from[2]; z <= to[2]; z++) {
                    at = DIM == 1 ? x : DIM == 2 ? x*shape[1] + y : (x*shape[1] + y)*shape[2] + z;
                    for (e = start[at]; e < start[at + 1]; e++) {
                        int j = inside[e], first = i < j ? i : j, second = i < j ? j : i;
                        double distance = 0.0;
                        if (small == large && j <= i) continue;
                        for (k = 0; k < DIM; k++) {
                            double difference = s->q[(ptrdiff_t)DIM*j + k] - q[k];
                            distance += difference*difference;
                        }
                        if (distance > (size[i] + size[j])*(size[i] + size[j])) continue;
                        if (!consider(s, rows, family, first, second, records + record*first, records + record*second, motion,
                                      report))
                            return 0;
                    }
                }
    }
    return 1;
}

/* Pairs of present bodies that may meet when none moves by more than `motion`, each once; 0 where one is not finite. */
static int search_pairs(const model_motion *s, model_rows *rows, int family, const double *records, double motion, model_arena *a,
                        model_report *report)
{
    double *size = TAKE(double, s->n), largest[SIZES] = {0.0}, least = INFINITY;
    signed char *kind = TAKE(signed char, s->n);
    int count[SIZES] = {0}, i, small, large;
    if (a->full) return 1;
    for (i = 0; i < s->n; i++) {
        /* a little more: what is left out is left out for certain */
        size[i] = (1.0 + FARTHER)*((s->halves ? s->halves[family][i] : 0.5*s->farthest[family]) + motion);
        if (!s->present[i]) continue;
        if (size[i] < least) least = size[i];
    }
    for (i = 0; i < s->n; i++) {
        kind[i] = -1;
        if (!s->present[i]) continue;
        kind[i] = 0;
        while (kind[i] < SIZES - 1 && size[i] > ldexp(least, kind[i] + 1)) kind[i]++;
        if (size[i] > largest[kind[i]]) largest[kind[i]] = size[i];
        count[kind[i]]++;
    }
    for (small = 0; small < SIZES; small++)
        for (large = small; large < SIZES; large++) {
            char *kept = a->next;
            if (!count[small] || !count[large]) continue;
            if (!search_between(s, rows, family, records, size, kind, small, large, largest[small] + largest[large], motion, a,
                                report))
                return 0;
            a->next = kept;
        }
    return 1;
}

/* All rows that may act when no body moves by more than `motion`; 0 where one is not finite. */
static int collect(const model_motion *s, model_rows *rows, const double *records, double motion, model_arena *a,
                   model_report *report)
{
    const ptrdiff_t width = s->model->record;
    int family, i, j;
    rows->count = 0;
    for (family = 0; family < s->model->families; family++) {
        if (s->over[family]) {
            const int *pair = s->over[family];
            for (i = 0; i < s->over_count[family]; i++, pair += 2) {
                const double *other = NULL;
                if (!s->present[pair[0]] || (s->model->of_bodies[family] && !s->present[pair[1]])) continue;
                if (s->model->of_bodies[family]) other = records + width*pair[1];
                else if (pair[1] >= 0) other = s->items[family] + (ptrdiff_t)s->model->item_size[family]*pair[1];
                if (!consider(s, rows, family, pair[0], pair[1], records + width*pair[0], other, motion, report)) return 0;
            }
        } else if (s->model->of_bodies[family] && s->farthest[family] >= 0.0) {
            /* g = |q_i - q_j| - c_ij: with c_ij <= half_i + half_j there is no row beyond that and 2 motion */
            char *kept = a->next;
            int fine = search_pairs(s, rows, family, records, motion, a, report);
            a->next = kept;
            if (!fine) return 0;
        } else if (s->model->of_bodies[family]) {
            for (i = 0; i < s->n; i++)
                for (j = i + 1; j < s->n; j++)
                    if (s->present[i] && s->present[j] &&
                        !consider(s, rows, family, i, j, records + width*i, records + width*j, motion, report))
                        return 0;
        } else {
            const ptrdiff_t own = s->model->item_size[family];
            int count = own ? s->item_count[family] : 1;
            for (i = 0; i < s->n; i++)
                for (j = 0; s->present[i] && j < count; j++)
                    if (!consider(s, rows, family, i, own ? j : -1, records + width*i,
                                  own ? s->items[family] + own*j : NULL, motion, report))
                        return 0;
        }
    }
    return 1;
}

#define NEAR 0.5   /* a row enters where the forces of the last step leave it less than this times the largest speed */
#define WIDER 2.0  /* how far is looked at first, beside what moved last and what wants to move now */
#define FARTHER_YET 1.5 /* then farther than they moved by this factor */
#define REPEATS 20 /* times that a step is taken again because bodies moved farther than was looked */

#if TIMES
static double seconds(void) { return (double)clock()/CLOCKS_PER_SEC; }
#endif

/* A step at work. In units of `unit`: b and g are the rows divided by |gradient|, w = d/(h unit) - f/unit = g' m. */
typedef struct {
    model_motion *s;
    model_report *report;
    model_arena *a;
    model_rows rows;
    double *records, *f, *w, *m, *b, *g;
    double speed, unit;               /* the largest |f|; the unit of velocities */
    unsigned char *entered, *acts, *fresh;
    int contacts;                     /* known: of the last step, then of an attempt at this one; start: by their first body */
    const int *family, *first, *second;
    const double *multiplier;
    int *start, *parent, *group;      /* group: of bodies that rows connect */
    int exhausted;                    /* there was more to do than the step may */
} model_work;

static int second_body(const model_work *k, int r)
{
    return k->s->model->of_bodies[k->rows.family[r]] ? k->rows.second[r] : -1;
}

/* The row r of g v. */
static double along_row(const model_work *k, int r, const double *g, const double *v)
{
    const double *slope = g + (ptrdiff_t)2*DIM*r, *one = v + (ptrdiff_t)DIM*k->rows.first[r];
    double sum = 0.0;
    int second = second_body(k, r), i;
    for (i = 0; i < DIM; i++) sum += slope[i]*one[i];
    if (second >= 0)
        for (i = 0; i < DIM; i++) sum += slope[DIM + i]*v[(ptrdiff_t)DIM*second + i];
    return sum;
}

/* v := v + l times the row r of g */
static void add_row(const model_work *k, int r, const double *g, double l, double *v)
{
    const double *slope = g + (ptrdiff_t)2*DIM*r;
    int second = second_body(k, r), i;
    for (i = 0; i < DIM; i++) v[(ptrdiff_t)DIM*k->rows.first[r] + i] += slope[i]*l;
    if (second >= 0)
        for (i = 0; i < DIM; i++) v[(ptrdiff_t)DIM*second + i] += slope[DIM + i]*l;
}

/* The bodies' numbers side by side and what each wants to do; the contacts of the last step by their first body. */
static int begin(model_work *k)
{
    const model_motion *s = k->s;
    model_arena *a = k->a;
    int n = s->n, width = s->model->record, i;
    k->records = TAKE(double, (ptrdiff_t)width*n + 1);
    k->f = TAKE(double, (ptrdiff_t)DIM*n + 1);
    k->w = TAKE(double, (ptrdiff_t)DIM*n + 1);
    k->start = TAKE(int, n + 2);
    k->parent = TAKE(int, n + 1);
    k->group = TAKE(int, n + 1);
    if (a->full) return MODEL_NO_ROOM;
    k->speed = 0.0;
    for (i = 0; i < n; i++) {
        double *record = k->records + (ptrdiff_t)width*i, *own = k->f + (ptrdiff_t)DIM*i, time = s->t;
        COPY(record, s->q + (ptrdiff_t)DIM*i, DIM);
        COPY(record + DIM, s->numbers + (ptrdiff_t)(width - DIM)*i, width - DIM);
        ZERO(own, DIM);
        if (!s->present[i]) continue;
        if (s->velocity) COPY(own, s->velocity + (ptrdiff_t)DIM*i, DIM);
        else s->model->velocity(NULL, &time, s->p, record, own);
        if (!isfinite(norm_of(own)) || !isfinite(norm_of(record))) {
            k->report->worst_first = i;
            return MODEL_NOT_FINITE;
        }
        if (norm_of(own) > k->speed) k->speed = norm_of(own);
    }
    k->contacts = s->contacts;
    k->family = s->family;
    k->first = s->first;
    k->second = s->second;
    k->multiplier = s->multiplier;
    ZERO(k->start, n + 2);
    for (i = 0; i < s->contacts; i++) k->start[s->first[i] + 1]++;
    for (i = 0; i < n; i++) k->start[i + 1] += k->start[i];
    return MODEL_OK;
}

#define ROWS_EACH 4  /* room for rows at first: so many for each body, two for each contact of the last step, */
#define ROWS_MORE 64 /* and so many more */

/* The rows that may act when nobody moves by more than `motion`. */
static int look(model_work *k, double motion)
{
    model_rows *rows = &k->rows;
    model_arena *a = k->a;
    char *mark = a->next;
    rows->room = ROWS_MORE + 2*k->contacts + ROWS_EACH*k->s->n;
    for (;;) {
        a->next = mark;
        rows->family = TAKE(int, rows->room);
        rows->first = TAKE(int, rows->room);
        rows->second = TAKE(int, rows->room);
        rows->g = TAKE(double, rows->room);
        rows->size = TAKE(double, rows->room);
        rows->slope = TAKE(double, (ptrdiff_t)2*DIM*rows->room);
        if (a->full) return MODEL_NO_ROOM;
        if (!collect(k->s, rows, k->records, motion, a, k->report)) return MODEL_NOT_FINITE;
        if (a->full) return MODEL_NO_ROOM;
        if (rows->count <= rows->room) break;
        rows->room = rows->count;
    }
    k->report->rows = rows->count;
    return MODEL_OK;
}

/* The multiplier that a row is known to have had. */
static double last_of(const model_work *k, int r)
{
    int e;
    for (e = k->start[k->rows.first[r]]; e < k->start[k->rows.first[r] + 1]; e++)
        if (k->second[e] == k->rows.second[r] && k->family[e] == k->rows.family[r]) return k->multiplier[e];
    return 0.0;
}

/* The rows in the step's units, and which of them enter; how many, -1: no memory. */
static int enter_rows(model_work *k)
{
    const model_motion *s = k->s;
    model_arena *a = k->a;
    int count = k->rows.count, entered = 0, r, i;
    k->entered = TAKE(unsigned char, count + 1);
    k->acts = TAKE(unsigned char, count + 1);
    k->fresh = TAKE(unsigned char, count + 1);
    k->m = TAKE(double, count + 1);
    k->b = TAKE(double, count + 1);
    k->g = TAKE(double, (ptrdiff_t)2*DIM*count + 1);
    if (!k->entered || !k->acts || !k->fresh || !k->m || !k->b || !k->g) return -1;
    k->unit = k->speed;
    for (r = 0; r < count; r++) {
        double size = k->rows.size[r], scale = size > 0.0 ? 1.0/size : 0.0;
        for (i = 0; i < 2*DIM; i++) k->g[(ptrdiff_t)2*DIM*r + i] = scale*k->rows.slope[(ptrdiff_t)2*DIM*r + i];
        k->b[r] = scale*k->rows.g[r]/s->h + along_row(k, r, k->g, k->f);
        if (size == 0.0) k->b[r] = k->rows.g[r] < 0.0 ? -1.0 : 1.0;
        if (-k->b[r] > k->unit) k->unit = -k->b[r];
    }
    if (!(k->unit > 0.0)) k->unit = 1.0;
    ZERO(k->w, (ptrdiff_t)DIM*s->n);
    for (r = 0; r < count; r++) {
        k->b[r] /= k->unit;
        k->m[r] = last_of(k, r)*k->rows.size[r]/(s->h*k->unit);
        k->acts[r] = k->m[r] > 0.0;
        if (k->acts[r]) add_row(k, r, k->g, k->m[r], k->w);
    }
    for (r = 0; r < count; r++) {
        k->entered[r] = k->b[r] < 0.0 || k->acts[r] || (k->contacts && k->b[r] + along_row(k, r, k->g, k->w) < NEAR);
        k->fresh[r] = k->entered[r];
        entered += k->entered[r];
        if (!k->contacts && k->b[r] < 0.0) k->acts[r] = 1;
    }
    ZERO(k->w, (ptrdiff_t)DIM*s->n);
    return entered;
}

static int root_of(int *parent, int i)
{
    while (parent[i] != i) i = parent[i] = parent[parent[i]];
    return i;
}

/* Number the groups of bodies that rows which entered connect: k->group of each body, -1 where it has no row; how many. */
static int number_groups(model_work *k)
{
    int n = k->s->n, groups = 0, i, r;
    for (i = 0; i < n; i++) k->parent[i] = i;
    for (r = 0; r < k->rows.count; r++)
        if (k->entered[r] && second_body(k, r) >= 0) {
            int one = root_of(k->parent, k->rows.first[r]), other = root_of(k->parent, second_body(k, r));
            if (one < other) k->parent[other] = one;
            else k->parent[one] = other;
        }
    for (i = 0; i < n; i++) k->group[i] = -1;
    for (r = 0; r < k->rows.count; r++)
        if (k->entered[r]) {
            i = root_of(k->parent, k->rows.first[r]);
            if (k->group[i] < 0) k->group[i] = groups++;
        }
    for (i = 0; i < n; i++) k->group[i] = k->group[root_of(k->parent, i)];
    return groups;
}

/* Solve the groups that have a fresh row, others stand; a row that waits belongs to a group if all its bodies do.
 * 0: no memory. */
static int solve_groups(model_work *k, int close)
{
    model_arena *a = k->a;
    int n = k->s->n, count = k->rows.count, groups = number_groups(k), group, i, r;
    int *rows_at = TAKE(int, groups + 2), *bodies_at = TAKE(int, groups + 2), *waiting = TAKE(int, groups + 1);
    int *row = TAKE(int, count + 1), *body = TAKE(int, n + 1), *number = TAKE(int, n + 1), *of = TAKE(int, count + 1);
    unsigned char *stale = TAKE(unsigned char, groups + 1);
    model_group p;
    int *first = TAKE(int, count + 1), *second = TAKE(int, count + 1);
    double *x = TAKE(double, (ptrdiff_t)DIM*n + 1);
    memset(&p, 0, sizeof p);
    p.w = TAKE(double, (ptrdiff_t)DIM*n + 1);
    p.g = TAKE(double, (ptrdiff_t)2*DIM*count + 1);
    p.b = TAKE(double, count + 1);
    p.multiplier = TAKE(double, count + 1);
    p.acts = TAKE(unsigned char, count + 1);
    if (a->full) return 0;
    ZERO(rows_at, groups + 2);
    ZERO(bodies_at, groups + 2);
    ZERO(waiting, groups + 1);
    ZERO(stale, groups + 1);
    for (r = 0; r < count; r++) {
        group = k->group[k->rows.first[r]];
        of[r] = !k->entered[r] && second_body(k, r) >= 0 && k->group[second_body(k, r)] != group ? -1 : group;
        if (of[r] < 0) continue;
        rows_at[group + 2]++;
        waiting[group] += !k->entered[r];
        if (k->fresh[r]) stale[group] = 1;
    }
    for (i = 0; i < n; i++)
        if (k->group[i] >= 0) bodies_at[k->group[i] + 2]++;
    for (group = 0; group < groups; group++) {
        rows_at[group + 2] += rows_at[group + 1];
        bodies_at[group + 2] += bodies_at[group + 1];
    }
    for (r = 0; r < count; r++)
        if (of[r] >= 0 && k->entered[r]) row[rows_at[of[r] + 1]++] = r;
    for (r = 0; r < count; r++)
        if (of[r] >= 0 && !k->entered[r]) row[rows_at[of[r] + 1]++] = r;
    for (i = 0; i < n; i++)
        if (k->group[i] >= 0) body[bodies_at[k->group[i] + 1]++] = i;
    for (group = 0; group < groups; group++)
        for (i = bodies_at[group]; i < bodies_at[group + 1]; i++) number[body[i]] = i - bodies_at[group];
    k->report->groups = groups;
    k->report->largest = 0;
    for (group = 0; group < groups && !k->exhausted; group++) {
        char *mark = a->next;
        const int *own = body + bodies_at[group];
        int how;
        p.row = row + rows_at[group];
        p.n = bodies_at[group + 1] - bodies_at[group];
        p.most = rows_at[group + 1] - rows_at[group];
        p.m = p.most - waiting[group];
        p.close = close;
        p.factorisations = 0;
        p.work = k->report->work;
        p.budget = k->s->budget;
        if (p.n > k->report->largest) k->report->largest = p.n;
        if (!stale[group]) continue;
        for (i = 0; i < p.n; i++) COPY(x + (ptrdiff_t)DIM*i, k->s->q + (ptrdiff_t)DIM*own[i], DIM);
        for (i = 0; i < p.most; i++) {
            r = p.row[i];
            first[i] = number[k->rows.first[r]];
            second[i] = second_body(k, r) >= 0 ? number[second_body(k, r)] : -1;
            COPY(p.g + (ptrdiff_t)2*DIM*i, k->g + (ptrdiff_t)2*DIM*r, 2*DIM);
            p.b[i] = k->b[r];
            p.multiplier[i] = k->m[r];
            p.acts[i] = k->acts[r];
        }
        p.x = x;
        p.first = first;
        p.second = second;
        how = solve_group(&p, a);
        k->report->work = p.work;
        k->exhausted |= p.exhausted;
        if (how < 0) return 0;
        k->report->factorisations += p.factorisations;
        k->report->by_active_set += how == BY_ACTIVE_SET;
        k->report->by_interior += how == BY_INTERIOR || how == BY_LAGRANGIAN;
        k->report->unsettled += how == UNSETTLED;
        for (i = 0; i < p.n; i++) COPY(k->w + (ptrdiff_t)DIM*own[i], p.w + (ptrdiff_t)DIM*i, DIM);
        for (i = 0; i < p.m; i++) {
            r = p.row[i];
            k->m[r] = p.multiplier[i];
            k->acts[r] = p.acts[i];
            k->entered[r] = 1;
        }
        a->next = mark;
    }
    return 1;
}

/* Let rows enter that w violates; how many. */
static int enter_violated(model_work *k)
{
    int count = 0, r;
    for (r = 0; r < k->rows.count; r++) {
        k->fresh[r] = !k->entered[r] && k->b[r] + along_row(k, r, k->g, k->w) < -WRONG;
        if (!k->fresh[r]) continue;
        k->entered[r] = k->acts[r] = 1;
        count++;
    }
    return count;
}

/* Move, and take the multipliers for those of the rows as they are; the largest |d_i|. */
static double move(model_work *k)
{
    const model_motion *s = k->s;
    double largest = 0.0;
    int i, j, r;
    for (r = 0; r < k->rows.count; r++)
        k->m[r] = k->entered[r] && k->rows.size[r] > 0.0 ? k->m[r]*s->h*k->unit/k->rows.size[r] : 0.0;
    for (i = 0; i < s->n; i++) {
        double d[DIM];
        for (j = 0; j < DIM; j++) {
            ptrdiff_t at = (ptrdiff_t)DIM*i + j;
            d[j] = s->present[i] ? s->h*(k->f[at] + k->unit*k->w[at]) : 0.0;
            s->q_next[at] = s->q[at] + d[j];
        }
        largest = worse_of(largest, norm_of(d));
    }
    return largest;
}

#define ROUND_OFF 16.0 /* times DBL_EPSILON: part of positions and terms that is none of the residual */

/* The residual without unit, from the definition: S is the largest of all h |f_i| and |d_i|; E = d - h f - G' m beside S; of each
 * row divided by its |gradient| the violation and min(m, |y|) beside S; the gap <m, |y|> beside |d|^2 + |h f|^2, or round-off.
 * 0: no memory. */
static int certify(model_work *k, double largest)
{
    const model_motion *s = k->s;
    model_arena *a = k->a;
    double worst = 0.0, gap = 0.0, noise = 0.0, moved = 0.0, far = 0.0, S = largest > s->h*k->speed ? largest : s->h*k->speed;
    double *d = TAKE(double, (ptrdiff_t)DIM*s->n + 1), *e = TAKE(double, (ptrdiff_t)DIM*s->n + 1), least;
    int i, r;
    if (a->full) return 0;
    for (i = 0; i < DIM*s->n; i++) {
        int there = s->present[i/DIM];
        d[i] = there ? s->q_next[i] - s->q[i] : 0.0;
        e[i] = d[i] - s->h*k->f[i];
        moved += d[i]*d[i] + s->h*s->h*k->f[i]*k->f[i];
        if (there && fabs(s->q[i]) > far) far = fabs(s->q[i]);
    }
    least = ROUND_OFF*DBL_EPSILON*(far + S)/s->tolerance;
    if (S < least) S = least;
    for (r = 0; r < k->rows.count; r++) {
        double y = k->rows.g[r] + along_row(k, r, k->rows.slope, d), bad, least_of;
        double size = k->rows.size[r] > 0.0 ? k->rows.size[r] : 1.0;
        add_row(k, r, k->rows.slope, -k->m[r], e);
        bad = -y/size;
        least_of = fabs(y)/size < k->m[r]*size ? fabs(y)/size : k->m[r]*size;
        bad = worse_of(bad, least_of);
        if (!(bad <= worst)) {
            worst = bad < INFINITY ? bad : INFINITY;
            k->report->worst_family = k->rows.family[r];
            k->report->worst_first = k->rows.first[r];
            k->report->worst_second = k->rows.second[r];
        }
        gap += k->m[r]*fabs(y);
        noise += k->m[r]*(fabs(k->rows.g[r]) + size*(S + far));
    }
    for (i = 0; i < DIM*s->n; i++) worst = worse_of(worst, fabs(e[i]));
    worst /= S > 0.0 ? S : 1.0;
    if (!(gap <= ROUND_OFF*DBL_EPSILON*noise) && !(gap <= worst*moved)) worst = gap/moved;
    /* a scale that is infinite excuses nothing */
    k->report->residual = isfinite(S + moved + noise) && worst < INFINITY ? worst : INFINITY;
    return 1;
}

/* List the rows with m > 0 as contacts, sorted by their first body. 0: no memory. */
static int list_contacts(model_work *k)
{
    model_motion *s = k->s;
    model_arena *a = k->a;
    int n = s->n, i, r;
    ZERO(k->start, n + 2);
    for (r = 0; r < k->rows.count; r++) k->start[k->rows.first[r] + 2] += k->m[r] > 0.0;
    for (i = 0; i < n; i++) k->start[i + 2] += k->start[i + 1];
    s->contacts_out = k->start[n + 1];
    s->family_out = TAKE(int, s->contacts_out + 1);
    s->first_out = TAKE(int, s->contacts_out + 1);
    s->second_out = TAKE(int, s->contacts_out + 1);
    s->multiplier_out = TAKE(double, s->contacts_out + 1);
    if (a->full) return 0;
    for (r = 0; r < k->rows.count; r++)
        if (k->m[r] > 0.0) {
            int at = k->start[k->rows.first[r] + 1]++;
            s->family_out[at] = k->rows.family[r];
            s->first_out[at] = k->rows.first[r];
            s->second_out[at] = k->rows.second[r];
            s->multiplier_out[at] = k->m[r];
        }
    return 1;
}

/* The contacts of this attempt are those known for the next; they move to where its memory begins. 0: no memory. */
static int know_contacts(model_work *k, char *begin)
{
    const model_motion *s = k->s;
    model_arena *a = k->a;
    size_t count;
    int *family, *first, *second;
    double *multiplier;
    if (!list_contacts(k)) return 0;
    a->next = begin;
    count = (size_t)s->contacts_out;
    family = TAKE(int, count + 1);
    first = TAKE(int, count + 1);
    second = TAKE(int, count + 1);
    multiplier = TAKE(double, count + 1);
    if (!family || !first || !second || !multiplier) return 0;
    k->contacts = s->contacts_out;
    k->family = memmove(family, s->family_out, count*sizeof(int));
    k->first = memmove(first, s->first_out, count*sizeof(int));
    k->second = memmove(second, s->second_out, count*sizeof(int));
    k->multiplier = memmove(multiplier, s->multiplier_out, count*sizeof(double));
    return 1;
}

/* Whether the linearisation of the row r, which acts, means nothing where the step leads: there are its value and gradients. */
static int leads_too_far(const model_work *k, int r, const double *there)
{
    const model_motion *s = k->s;
    const double *slope = k->rows.slope + (ptrdiff_t)2*DIM*r;
    double off = there[0] - k->rows.g[r], turned = 0.0, moved = 0.0;
    int second = second_body(k, r), j;
    for (j = 0; j < (second < 0 ? DIM : 2*DIM); j++) {
        ptrdiff_t at = (ptrdiff_t)DIM*(j < DIM ? k->rows.first[r] : second) + j%DIM;
        double d = s->q_next[at] - s->q[at];
        off -= slope[j]*d;
        turned += (there[1 + j] - slope[j])*d;
        if (slope[j] != 0.0 || there[1 + j] != 0.0) moved += d*d;
    }
    if (turned < off) off = turned;
    return !(off <= REACH*k->rows.size[r]*sqrt(moved));
}

/* The gaps at the new positions, the contacts, and who leaves. */
static int finish(model_work *k)
{
    model_motion *s = k->s;
    int n = s->n, width = s->model->record, i, r;
    k->report->gap = INFINITY;
    for (i = 0; i < n; i++) COPY(k->records + (ptrdiff_t)width*i, s->q_next + (ptrdiff_t)DIM*i, DIM);
    for (r = 0; r < k->rows.count; r++) {
        double out[1 + 2*DIM];
        const double *other = NULL;
        int family = k->rows.family[r], second = k->rows.second[r];
        if (second_body(k, r) >= 0) other = k->records + (ptrdiff_t)width*second;
        else if (second >= 0) other = s->items[family] + (ptrdiff_t)s->model->item_size[family]*second;
        evaluate(s, s->t + s->h, family, k->records + (ptrdiff_t)width*k->rows.first[r], other, out);
        if (k->report->gap == k->report->gap && !(out[0] >= k->report->gap)) k->report->gap = out[0];
        if (k->m[r] > 0.0 && leads_too_far(k, r, out)) {
            k->report->worst_family = family;
            k->report->worst_first = k->rows.first[r];
            k->report->worst_second = second;
            return MODEL_NOT_SOLVED;
        }
    }
    if (!list_contacts(k)) return MODEL_NO_ROOM;
    for (i = 0; i < n && s->leaves; i++) {
        double time = s->t + s->h, value = 0.0;
        if (s->present[i] && s->model->leave) s->model->leave(NULL, &time, s->p, k->records + (ptrdiff_t)width*i, &value);
        s->leaves[i] = value > 0.0;
    }
    return MODEL_OK;
}

/* One step; `memory` is for use in it alone: nothing is kept. On MODEL_NO_ROOM *missing says how much more is needed. */
#if !EXPORTED
static
#endif
int move_bodies(model_motion *s, char *memory, size_t size, size_t *missing, model_report *report)
{
    model_arena arena = {memory, memory + size, 0, 0};
    model_work work, *k = &work;
    double motion, largest = 0.0;
    char *mark;
    int status, fresh, pass;
#if TIMES
    double before = seconds(), now;
#endif
    memset(report, 0, sizeof *report);
    memset(k, 0, sizeof *k);
    report->worst_family = -1;
    report->residual = INFINITY;
    k->s = s;
    k->report = report;
    k->a = &arena;
    status = begin(k);
    if (status == MODEL_NO_ROOM) goto no_room;
    if (status != MODEL_OK) return status;
    mark = arena.next;
    motion = WIDER*(s->h*k->speed > s->motion ? s->h*k->speed : s->motion);
    for (;; report->repeats++) {
        status = look(k, motion);
        if (status == MODEL_NO_ROOM) goto no_room;
        if (status != MODEL_OK) return status;
#if TIMES
        now = seconds();
        report->search += now - before;
        before = now;
#endif
        fresh = enter_rows(k);
        if (fresh < 0) goto no_room;
#if TIMES
        now = seconds();
        report->assembly += now - before;
        before = now;
#endif
        for (pass = 0; fresh; pass++) {
            char *inner = arena.next;
            if (!solve_groups(k, pass > 0 || report->repeats > 0)) goto no_room;
            if (k->exhausted) return MODEL_NOT_SOLVED;
            arena.next = inner;
            fresh = enter_violated(k);
        }
        largest = move(k);
#if TIMES
        now = seconds();
        report->solve += now - before;
        before = now;
#endif
        report->motion = largest;
        report->cutoff = motion;
        if (!isfinite(largest)) return MODEL_NOT_SOLVED;
        if (largest <= motion) break;
        if (report->repeats == REPEATS) return MODEL_NOT_SOLVED;
        motion = FARTHER_YET*largest;
        if (!know_contacts(k, mark)) goto no_room;
    }
    if (!certify(k, largest)) goto no_room;
    if (!(report->residual <= s->tolerance)) return MODEL_NOT_SOLVED;
    status = finish(k);
    if (status == MODEL_NO_ROOM) goto no_room;
#if TIMES
    report->assembly += seconds() - before;
#endif
    return status;
no_room:
    *missing = arena.missing;
    return MODEL_NO_ROOM;
}
