/* ---- Sparse L D L' of symmetric positive definite matrices of DIM x DIM blocks, multifrontal ---- */

#define LINE 64 /* bytes of a line of the processor's cache */

/* Memory of a step: pieces of one array, taken in order and given back all at once. */
typedef struct {
    char *next, *end;
    size_t missing; /* bytes more that were asked for; */
    int full;       /* then nothing of what was taken may be used */
} model_arena;

static void *take(model_arena *a, size_t count, size_t size)
{
    size_t bytes = (count*size + LINE - 1) & ~(size_t)(LINE - 1);
    char *start = a->next;
    if (bytes > (size_t)(a->end - start)) {
        a->missing += bytes;
        a->full = 1;
        return NULL;
    }
    a->next += bytes;
    return start;
}

#define TAKE(type, count) ((type *)take(a, (size_t)(count), sizeof(type)))
#define COPY(to, from, count) memcpy(to, from, (size_t)(count)*sizeof *(to))
#define ZERO(to, count) memset(to, 0, (size_t)(count)*sizeof *(to))

typedef struct {
    int n;                     /* block rows */
    int *place;                /* (n) position of a block row in the order */
    int *up, *at;              /* (n + 1), rows of the upper triangle of A; (pairs) where in its column of L a block of them is */
    double *a, *diagonal;      /* their blocks; (n) diagonal blocks of A */
    int nodes;                 /* sets of columns of L with (nearly) the same rows below; they form a tree */
    int *begin;                /* (nodes + 1) first column of a node */
    int *parent, *child, *sibling;  /* -1: none */
    int *start, *row, *into;   /* (nodes + 1), rows of a node below its own; where they are in the columns of its parent */
    ptrdiff_t *panel;             /* (nodes) where its columns are: its own rows, those below, each padded to tiles of 4 */
    double *l;                 /* L D below the 4 x 4 tiles of the diagonal; in these D^-1 and, above it, L^-1 of the tile */
    double *update[2];         /* what is left for the parents, from even depth and from odd */
    double *z;                 /* (longest column) */
} model_ldl;

#define BLOCK (DIM*DIM)
#define PADDED(count) (((count) + 3) & ~3)
#define LEAF 12       /* block rows that are not divided any more */
#define BAND 4.0      /* rows of bodies on each side of the middle among which a part is cut */
#define DEGREE 5      /* neighbours up to which a block row is eliminated before the division */
#define SLACK 8       /* neighbours that one may gain */
#define MIDDLE 6      /* the cut is looked for in one part of so many on each side of the middle */
#define NODE_COST 20.0 /* of a node without columns and rows */

static int width_of(const model_ldl *f, int s) { return PADDED(DIM*(f->begin[s + 1] - f->begin[s])); }
static int rest_of(const model_ldl *f, int s) { return PADDED(DIM*(f->start[s + 1] - f->start[s])); }

/* Sort items by the direction's coordinate, by merging. */
static void sort_along(int *items, int count, const double *key, int *spare)
{
    int half = count/2, i, j = half, k;
    if (count < 2) return;
    sort_along(items, half, key, spare);
    sort_along(items + half, count - half, key, spare);
    COPY(spare, items, half);
    for (i = 0, k = 0; i < half; k++)
        items[k] = j < count && key[(ptrdiff_t)DIM*items[j]] < key[(ptrdiff_t)DIM*spare[i]] ? items[j++] : spare[i++];
}

/* What is left of the graph of the pairs, and the part of it that is divided. */
typedef struct {
    int *first, *degree, *around;      /* neighbours */
    int *sorted[DIM];                  /* the block rows along each axis */
    int *position, low, high;          /* of a row of the part along one of them, else OUT; the part is cut in low ... high - 1 */
    int *before, *after;               /* the rows beside one on its path from below low to high: NONE, or an END of the path */
    int *entered, *left, round;        /* the last round in which a row was, and in which paths led on from it */
    int *trail, *via, *edge;           /* rows that a search led on from, the row that it entered for each, neighbours looked at */
    int *starts, *spare;
} model_graph;

#define OUT (-1)
#define END (-1)
#define NONE (-2)

/* One more path that meets no other, from a row beside those below low to one beside those from high on; others may be led
 * elsewhere for it (Ford and Fulkerson, with room for one path in each row). 0: there is none. */
static int add_path(model_graph *g, int start)
{
    int depth = -1, into = start, k;
    for (;;) {
        int v;
        if (into >= 0 && g->entered[into] != g->round) {
            int on = g->before[into] == NONE ? into : g->before[into];
            g->entered[into] = g->round;
            if (on >= 0 && g->left[on] != g->round) {
                g->left[on] = g->round;
                g->trail[++depth] = on;
                g->via[depth] = into;
                g->edge[depth] = 0;
            }
        }
        if (depth < 0) return 0;
        v = g->trail[depth];
        k = g->edge[depth]++;
        into = -1;
        if (k > g->degree[v]) depth--;
        else if (k == g->degree[v]) {
            if (g->before[v] != NONE) into = v;
        } else {
            int u = g->around[g->first[v] + k];
            if (g->position[u] >= g->high) break;
            if (g->position[u] >= g->low && (g->before[v] == NONE || g->after[v] != u)) into = u;
        }
    }
    for (k = 0; k <= depth; k++) {
        int u = g->via[k], from = k ? g->trail[k - 1] : END;
        g->before[u] = u == from ? NONE : from;
        if (k && u != from) g->after[from] = u;
    }
    g->after[g->trail[depth]] = END;
    return 1;
}

/* Order block rows by nested dissection: one part, the other, then the fewest rows in the middle without which no pair connects
 * the two: as many as there are paths between them that do not meet (Menger). */
static void dissect(model_graph *g, const double *x, int from, int count)
{
    while (count > LEAF) {
        int axis = 0, starts = 0, half = (int)(BAND*pow(count, 1.0 - 1.0/DIM)), inner = 0, kept = 0, d, e, i, found;
        double longest = -1.0;
        int *items;
        for (d = 0; d < DIM; d++) {
            double extent;
            items = g->sorted[d] + from;
            extent = x[(ptrdiff_t)DIM*items[count - 1] + d] - x[(ptrdiff_t)DIM*items[0] + d];
            if (extent > longest) {
                longest = extent;
                axis = d;
            }
        }
        items = g->sorted[axis] + from;
        if (half > count/MIDDLE) half = count/MIDDLE;
        g->low = count/2 - half;
        g->high = count - g->low;
        for (i = 0; i < count; i++) g->position[items[i]] = i;
        for (i = g->low; i < g->high; i++) g->before[items[i]] = NONE;
        for (i = 0; i < g->high; i++) {
            const int *around = g->around + g->first[items[i]];
            int least = count, most = OUT;
            for (e = 0; e < g->degree[items[i]]; e++) {
                int at = g->position[around[e]];
                if (at > most) most = at;
                if (at != OUT && at < least) least = at;
            }
            if (i < g->low && most >= g->high) g->position[items[i]] = OUT;
            if (i >= g->low && least < g->low) g->starts[starts++] = items[i];
        }
        do {
            g->round++;
            for (i = 0, found = 0; i < starts; i++) found += add_path(g, g->starts[i]);
        } while (found);
        for (i = g->low; i < g->high; i++)
            if (g->entered[items[i]] == g->round && g->left[items[i]] != g->round) g->position[items[i]] = OUT;
        for (d = 0; d < DIM; d++) {
            int *right = g->starts, *covering = g->spare, cut = 0;
            items = g->sorted[d] + from;
            inner = kept = 0;
            for (i = 0; i < count; i++) {
                int v = items[i], at = g->position[v];
                if (at == OUT) covering[cut++] = v;
                else if (at < g->low || (at < g->high && g->left[v] == g->round)) items[inner++] = v;
                else right[kept++] = v;
            }
            COPY(items + inner, right, kept);
            COPY(items + inner + kept, covering, cut);
        }
        dissect(g, x, from, inner);
        from += inner;
        count = kept;
    }
}

/* Order block rows: those of few neighbours by minimum degree, the others by nested dissection of what is left of the graph. */
static int arrange(int *order, int n, const double *x, const int *near, const int *neighbour, model_arena *a)
{
    int *first = TAKE(int, n), *degree = TAKE(int, n), *around = TAKE(int, near[n] + SLACK*(ptrdiff_t)n), *mark = TAKE(int, n);
    int *stack = TAKE(int, (DEGREE + 1)*(ptrdiff_t)n + 1), limit, i, j, k, e, tag = 0, count = 0, rest;
    model_graph g = {0};
    for (i = 0; i < DIM; i++) g.sorted[i] = TAKE(int, n);
    g.position = TAKE(int, n);
    g.before = TAKE(int, n);
    g.after = TAKE(int, n);
    g.entered = TAKE(int, n);
    g.left = TAKE(int, n);
    g.trail = TAKE(int, n);
    g.via = TAKE(int, n);
    g.edge = TAKE(int, n);
    g.starts = TAKE(int, n);
    if (a->full) return 0;
    for (i = 0; i < n; i++) {
        first[i] = near[i] + SLACK*i;
        degree[i] = near[i + 1] - near[i];
        COPY(around + first[i], neighbour + near[i], degree[i]);
        mark[i] = 0;
    }
    for (limit = 0; limit <= DEGREE; limit++)
        for (i = 0; i < n; i++) {
            int depth = 0;
            stack[depth++] = i;
            while (depth) {
                int v = stack[--depth], d = degree[v], fits = 1;
                const int *clique = around + first[v];
                if (d < 0 || d > limit) continue;
                for (j = 0; j < d; j++) {
                    int u = clique[j];
                    fits &= degree[u] + d - 2 <= near[u + 1] - near[u] + SLACK;
                }
                if (!fits) continue;
                for (j = 0; j < d; j++) {
                    int u = clique[j], *own = around + first[u], size = 0;
                    mark[u] = ++tag;
                    for (e = 0; e < degree[u]; e++) {
                        mark[own[e]] = tag;
                        if (own[e] != v) own[size++] = own[e];
                    }
                    for (k = 0; k < d; k++)
                        if (mark[clique[k]] != tag) own[size++] = clique[k];
                    degree[u] = size;
                    if (size <= limit) stack[depth++] = u;
                }
                degree[v] = -1;
                order[count++] = v;
            }
        }
    for (i = 0, rest = 0; i < n; i++) {
        if (degree[i] >= 0) {
            for (j = 0; j < DIM; j++) g.sorted[j][rest] = i;
            rest++;
        }
        mark[i] = g.entered[i] = g.left[i] = 0;
    }
    for (j = 0; j < DIM; j++) sort_along(g.sorted[j], rest, x + j, stack);
    g.first = first;
    g.degree = degree;
    g.around = around;
    g.spare = stack;
    dissect(&g, x, 0, rest);
    COPY(order + count, g.sorted[0], rest);
    return 1;
}

/* Work on a node of some columns with some rows below: elimination, handing on what is left, and what any node costs. */
static double cost_of(int columns, int rows)
{
    double width = PADDED(DIM*columns)/4, rest = PADDED(DIM*rows)/4;
    return width*(width*width/3.0 + width*rest + rest*rest*0.5) + rest*rest + NODE_COST;
}

/* Order, tree and pattern for n block rows at x and pairs (first, second), second < 0 where there is none;
 * slot[i]: the block of A of pair i, -1 where there is none; pairs of the same block rows add up. */
static int prepare_ldl(model_ldl *f, int n, const double *x, int pairs, const int *first, const int *second, int *slot,
                       model_arena *a)
{
    int i, k, e, s, longest = 0;
    int *near = TAKE(int, n + 2), *neighbour = TAKE(int, 2*(ptrdiff_t)pairs + 1), *to = TAKE(int, pairs + 1);
    int *order = TAKE(int, n), *above = TAKE(int, n), *count = TAKE(int, n), *size = TAKE(int, n), *last = TAKE(int, n + 1);
    int *column = TAKE(int, n), *after = TAKE(int, n), *below = TAKE(int, n), *node = TAKE(int, n);
    int *mark = TAKE(int, n), *filled = TAKE(int, n);
    double *cost = TAKE(double, n);
    ptrdiff_t *own = TAKE(ptrdiff_t, n), *other = TAKE(ptrdiff_t, n), *waiting = TAKE(ptrdiff_t, n), total = 0, most[2] = {0, 0};
    f->n = n;
    f->place = TAKE(int, n);
    f->up = TAKE(int, n + 2);
    f->at = TAKE(int, pairs + 1);
    f->a = TAKE(double, (ptrdiff_t)BLOCK*(pairs + 1));
    f->diagonal = TAKE(double, (ptrdiff_t)BLOCK*n);
    f->begin = TAKE(int, n + 1);
    f->parent = TAKE(int, n);
    f->child = TAKE(int, n);
    f->sibling = TAKE(int, n);
    f->start = TAKE(int, n + 2);
    f->panel = TAKE(ptrdiff_t, n);
    if (a->full) return 0;
    ZERO(near, n + 2);
    for (i = 0; i < pairs; i++)
        if (second[i] >= 0) {
            near[first[i] + 2]++;
            near[second[i] + 2]++;
        }
    for (i = 0; i < n; i++) near[i + 2] += near[i + 1];
    for (i = 0; i < pairs; i++)
        if (second[i] >= 0) {
            neighbour[near[first[i] + 1]++] = second[i];
            neighbour[near[second[i] + 1]++] = first[i];
        }
    if (!arrange(order, n, x, near, neighbour, a)) return 0;
    /* elimination tree and column counts */
    for (k = 0; k < n; k++) f->place[order[k]] = k;
    for (k = 0; k < n; k++) {
        mark[k] = k;
        above[k] = n;
        count[k] = 0;
        size[k] = 1;
        for (e = near[order[k]]; e < near[order[k] + 1]; e++) {
            i = f->place[neighbour[e]];
            if (i > k) continue;
            for (; mark[i] != k; i = above[i]) {
                if (above[i] == n) above[i] = k;
                count[i]++;
                mark[i] = k;
            }
        }
    }
    /* each column right after those below it in the tree */
    for (k = 0; k < n; k++)
        if (above[k] < n) size[above[k]] += size[k];
    last[n] = n - 1;
    for (k = n - 1; k >= 0; k--) {
        column[k] = last[above[k]];
        last[above[k]] -= size[k];
        last[k] = column[k] - 1;
        f->place[order[k]] = column[k];
        after[column[k]] = above[k] < n ? column[above[k]] : n;
        below[column[k]] = count[k];
    }
    for (i = 0; i < n; i++) order[f->place[i]] = i;
    /* nodes: a column joins the node before it where that costs less */
    f->nodes = 0;
    for (k = 0; k < n; k++) {
        s = f->nodes++;
        f->begin[s] = k;
        cost[s] = cost_of(1, below[k]);
        while (s > 0 && after[f->begin[s] - 1] <= k) {
            double joined = cost_of(k + 1 - f->begin[s - 1], below[k]);
            if (joined > cost[s - 1] + cost[s]) break;
            cost[--s] = joined;
            f->nodes--;
        }
    }
    f->begin[f->nodes] = n;
    f->start[0] = 0;
    for (s = 0; s < f->nodes; s++) {
        for (k = f->begin[s]; k < f->begin[s + 1]; k++) node[k] = s;
        filled[s] = f->start[s];
        f->start[s + 1] = f->start[s] + below[f->begin[s + 1] - 1];
        f->child[s] = f->sibling[s] = mark[s] = -1;
    }
    for (s = f->nodes - 1; s >= 0; s--) {
        k = after[f->begin[s + 1] - 1];
        f->parent[s] = k < n ? node[k] : -1;
        if (k < n) {
            f->sibling[s] = f->child[node[k]];
            f->child[node[k]] = s;
        }
    }
    /* rows of the nodes */
    f->row = TAKE(int, f->start[f->nodes] + 1);
    f->into = TAKE(int, f->start[f->nodes] + 1);
    if (a->full) return 0;
    for (k = 0; k < n; k++)
        for (e = near[order[k]]; e < near[order[k] + 1]; e++) {
            i = f->place[neighbour[e]];
            if (i > k) continue;
            for (s = node[i]; s != node[k] && mark[s] != k; s = f->parent[s]) {
                int p = f->parent[s], q = filled[s]++;
                mark[s] = k;
                f->row[q] = k;
                f->into[q] = p == node[k] ? DIM*(k - f->begin[p])
                                          : width_of(f, p) + DIM*(filled[p] - f->start[p] - (mark[p] == k));
            }
        }
    /* where the blocks of A are */
    ZERO(f->up, n + 2);
    for (i = 0; i < pairs; i++)
        if (second[i] >= 0) {
            int one = f->place[first[i]], two = f->place[second[i]];
            f->up[(one < two ? one : two) + 2]++;
        }
    for (i = 0; i < n; i++) f->up[i + 2] += f->up[i + 1];
    for (i = 0; i < pairs; i++) {
        slot[i] = -1;
        if (second[i] >= 0) {
            int one = f->place[first[i]], two = f->place[second[i]];
            slot[i] = f->up[(one < two ? one : two) + 1]++;
            to[slot[i]] = one < two ? two : one;
        }
    }
    for (s = 0; s < f->nodes; s++) {
        int width = width_of(f, s);
        for (i = f->start[s]; i < f->start[s + 1]; i++) mark[f->row[i]] = width + DIM*(i - f->start[s]);
        for (k = f->begin[s]; k < f->begin[s + 1]; k++) mark[k] = DIM*(k - f->begin[s]);
        for (e = f->up[f->begin[s]]; e < f->up[f->begin[s + 1]]; e++) f->at[e] = mark[to[e]];
    }
    /* the panels, and how far the updates that wait for their parents pile up */
    for (s = 0; s < f->nodes; s++) own[s] = other[s] = waiting[s] = 0;
    for (s = 0; s < f->nodes; s++) {
        int p = f->parent[s], rest = rest_of(f, s), height = width_of(f, s) + rest;
        ptrdiff_t left = (ptrdiff_t)rest*rest;
        f->panel[s] = total;
        total += (ptrdiff_t)height*width_of(f, s);
        if (height > longest) longest = height;
        if (left > own[s]) own[s] = left;
        if (p < 0) {
            if (own[s] > most[0]) most[0] = own[s];
            if (other[s] > most[1]) most[1] = other[s];
        } else {
            if (waiting[p] + own[s] > other[p]) other[p] = waiting[p] + own[s];
            if (other[s] > own[p]) own[p] = other[s];
            waiting[p] += left;
        }
    }
    f->l = TAKE(double, total);
    f->update[0] = TAKE(double, most[0]);
    f->update[1] = TAKE(double, most[1]);
    f->z = TAKE(double, longest);
    return !a->full;
}

/* The tile of 4 columns loses what 4 columns v of a panel make of them; its first row is the panel's row `row`. */
static void subtract_tile(double *restrict tile, ptrdiff_t stride, const double *restrict v, ptrdiff_t height, int row, int count)
{
    const double *restrict v0 = v + row, *restrict v1 = v0 + height, *restrict v2 = v1 + height, *restrict v3 = v2 + height;
    double *restrict t0 = tile, *restrict t1 = t0 + stride, *restrict t2 = t1 + stride, *restrict t3 = t2 + stride;
    double d0 = v[0], d1 = v[height + 1], d2 = v[2*height + 2], d3 = v[3*height + 3];
    double a0 = v0[0]*d0, a1 = v1[0]*d1, a2 = v2[0]*d2, a3 = v3[0]*d3, b0 = v0[1]*d0, b1 = v1[1]*d1, b2 = v2[1]*d2, b3 = v3[1]*d3;
    double c0 = v0[2]*d0, c1 = v1[2]*d1, c2 = v2[2]*d2, c3 = v3[2]*d3, e0 = v0[3]*d0, e1 = v1[3]*d1, e2 = v2[3]*d2, e3 = v3[3]*d3;
    int i, k;
    for (i = 0; i < count; i += 4)
        for (k = i; k < i + 4; k++) {
            t0[k] -= v0[k]*a0 + v1[k]*a1 + v2[k]*a2 + v3[k]*a3;
            t1[k] -= v0[k]*b0 + v1[k]*b1 + v2[k]*b2 + v3[k]*b3;
            t2[k] -= v0[k]*c0 + v1[k]*c1 + v2[k]*c2 + v3[k]*c3;
            t3[k] -= v0[k]*e0 + v1[k]*e1 + v2[k]*e2 + v3[k]*e3;
        }
}

/* Eliminate 4 columns, v[0] the first on the diagonal: D^-1 there, L D below their triangle, and above it the inverse of L. */
static void eliminate_tile(double *v, ptrdiff_t height, int count)
{
    double *restrict v0 = v, *restrict v1 = v0 + height, *restrict v2 = v1 + height, *restrict v3 = v2 + height;
    double d0, d1, d2, d3, l10, l20, l30, l21, l31, l32, u12, u13, u23;
    int i, k;
    d0 = v0[0] > 0.0 ? 1.0/v0[0] : 0.0;
    l10 = v0[1]*d0;
    l20 = v0[2]*d0;
    l30 = v0[3]*d0;
    d1 = v1[1] - v0[1]*l10;
    d1 = d1 > 0.0 ? 1.0/d1 : 0.0;
    u12 = v1[2] - v0[2]*l10;
    u13 = v1[3] - v0[3]*l10;
    l21 = u12*d1;
    l31 = u13*d1;
    d2 = v2[2] - v0[2]*l20 - u12*l21;
    d2 = d2 > 0.0 ? 1.0/d2 : 0.0;
    u23 = v2[3] - v0[3]*l20 - u13*l21;
    l32 = u23*d2;
    d3 = v3[3] - v0[3]*l30 - u13*l31 - u23*l32;
    d3 = d3 > 0.0 ? 1.0/d3 : 0.0;
    v0[0] = d0;
    v1[1] = d1;
    v2[2] = d2;
    v3[3] = d3;
    v1[0] = -l10;
    v2[1] = -l21;
    v3[2] = -l32;
    v2[0] = l21*l10 - l20;
    v3[1] = l32*l21 - l31;
    v3[0] = l31*l10 - l32*v2[0] - l30;
    for (i = 4; i < count; i += 4)
        for (k = i; k < i + 4; k++) {
            double second = v1[k] - v0[k]*l10, third = v2[k] - v0[k]*l20 - second*l21;
            v1[k] = second;
            v2[k] = third;
            v3[k] -= v0[k]*l30 + second*l31 + third*l32;
        }
}

/* Eliminate the columns of a node, after its children: L D and D^-1 go to its panel, what is left of its rows to update; the
 * children leave theirs in spare, one after the other. */
static void factor_node(model_ldl *f, int s, double *update, double *spare)
{
    int width = width_of(f, s), rest = rest_of(f, s), i, j, k, r, e, c;
    ptrdiff_t height = width + rest;
    double *panel = f->l + f->panel[s], *left = spare;
    for (c = f->child[s]; c >= 0; c = f->sibling[c]) {
        factor_node(f, c, left, update);
        left += (ptrdiff_t)rest_of(f, c)*rest_of(f, c);
    }
    ZERO(panel, width*height);
    ZERO(update, (ptrdiff_t)rest*rest);
    for (k = f->begin[s]; k < f->begin[s + 1]; k++)
        for (j = 0; j < DIM; j++) {
            int own = DIM*(k - f->begin[s]);
            double *column = panel + (own + j)*height;
            for (r = 0; r < DIM; r++) column[own + r] = f->diagonal[(ptrdiff_t)BLOCK*k + r*DIM + j];
            for (e = f->up[k]; e < f->up[k + 1]; e++)
                for (r = 0; r < DIM; r++) column[f->at[e] + r] += f->a[(ptrdiff_t)BLOCK*e + j*DIM + r];
        }
    left = spare;
    for (c = f->child[s]; c >= 0; c = f->sibling[c]) {
        const int *into = f->into + f->start[c];
        int size = f->start[c + 1] - f->start[c], stride = rest_of(f, c);
        for (k = 0; k < size; k++)
            for (j = 0; j < DIM; j++) {
                const double *from = left + (ptrdiff_t)(DIM*k + j)*stride;
                double *to = into[k] < width ? panel + (into[k] + j)*height : update + (ptrdiff_t)(into[k] + j - width)*rest - width;
                for (i = k; i < size; i++) {
                    double sum[DIM];
                    for (r = 0; r < DIM; r++) sum[r] = to[into[i] + r] + from[DIM*i + r];
                    for (r = 0; r < DIM; r++) to[into[i] + r] = sum[r];
                }
            }
        left += (ptrdiff_t)stride*stride;
    }
    for (j = 0; j < width; j += 4) {
        double *v = panel + j*height;
        eliminate_tile(v + j, height, (int)height - j);
        for (k = j + 4; k < width; k += 4) subtract_tile(panel + k*height + k, height, v + j, height, k - j, (int)height - k);
    }
    for (k = 0; k < rest; k += 4)
        for (j = 0; j < width; j += 4)
            subtract_tile(update + (ptrdiff_t)k*rest + k, rest, panel + j*height + j, height, width + k - j, rest - k);
}

/* Factor A; a pivot that is not positive, by rounding, is taken for infinite. */
static void factor_ldl(model_ldl *f)
{
    int s;
    for (s = 0; s < f->nodes; s++)
        if (f->parent[s] < 0) factor_node(f, s, f->update[0], f->update[1]);
}

/* Solves read L once from end to end, which is longer than the processor looks ahead by itself when L is not in its cache: ask
 * for the 4 x 4 tile that is AHEAD bytes away. */
#define AHEAD 8192
#ifdef __GNUC__
#define FETCH(address) (__builtin_prefetch((const void *)(address)), __builtin_prefetch((const void *)((address) + LINE)))
#else
#define FETCH(address) ((void)0)
#endif

/* z := (L D)^-1 z for the columns of a node, then what they take from its rows; below the diagonal L D, on it D^-1. */
static void forward(const double *restrict v0, double *restrict z, int width, int height)
{
    int i, j, k;
    for (j = 0; j < width; j += 4, v0 += 4*(ptrdiff_t)height) {
        const double *restrict v1 = v0 + height, *restrict v2 = v1 + height, *restrict v3 = v2 + height;
        double z0 = z[j]*v0[j], z1 = (z[j + 1] + v1[j]*z[j])*v1[j + 1];
        double z2 = (z[j + 2] + v2[j]*z[j] + v2[j + 1]*z[j + 1])*v2[j + 2];
        double z3 = (z[j + 3] + v3[j]*z[j] + v3[j + 1]*z[j + 1] + v3[j + 2]*z[j + 2])*v3[j + 3];
        z[j] = z0;
        z[j + 1] = z1;
        z[j + 2] = z2;
        z[j + 3] = z3;
        for (i = j + 4; i < height; i += 4) {
            FETCH((size_t)(v0 + 4*(size_t)(i - j)) + AHEAD);
            for (k = i; k < i + 4; k++) z[k] -= v0[k]*z0 + v1[k]*z1 + v2[k]*z2 + v3[k]*z3;
        }
    }
}

/* z := z - D^-1 (L D)' z for the columns of a node, from those of its rows. */
static void backward(const double *restrict v0, double *restrict z, int width, int height)
{
    int i, j, k;
    v0 += width*(ptrdiff_t)height;
    for (j = width - 4; j >= 0; j -= 4) {
        const double *restrict v1, *restrict v2, *restrict v3;
        double s0[4] = {0.0}, s1[4] = {0.0}, s2[4] = {0.0}, s3[4] = {0.0}, t0, t1, t2, t3;
        v0 -= 4*(ptrdiff_t)height;
        v1 = v0 + height;
        v2 = v1 + height;
        v3 = v2 + height;
        for (i = j + 4; i < height; i += 4) {
            FETCH((size_t)(v0 + 4*(size_t)(i - j)) - AHEAD);
            for (k = 0; k < 4; k++) {
                s0[k] += v0[i + k]*z[i + k];
                s1[k] += v1[i + k]*z[i + k];
                s2[k] += v2[i + k]*z[i + k];
                s3[k] += v3[i + k]*z[i + k];
            }
        }
        t0 = z[j] - v0[j]*((s0[0] + s0[1]) + (s0[2] + s0[3]));
        t1 = z[j + 1] - v1[j + 1]*((s1[0] + s1[1]) + (s1[2] + s1[3]));
        t2 = z[j + 2] - v2[j + 2]*((s2[0] + s2[1]) + (s2[2] + s2[3]));
        t3 = z[j + 3] - v3[j + 3]*((s3[0] + s3[1]) + (s3[2] + s3[3]));
        z[j] = t0 + v1[j]*t1 + v2[j]*t2 + v3[j]*t3;
        z[j + 1] = t1 + v2[j + 1]*t2 + v3[j + 1]*t3;
        z[j + 2] = t2 + v3[j + 2]*t3;
        z[j + 3] = t3;
    }
}

/* x := A^-1 x, x in the order of the factor (n*DIM). */
static void solve_ldl(const model_ldl *f, double *x)
{
    double *z = f->z;
    int s, i, r;
    for (s = 0; s < f->nodes; s++) {
        int own = DIM*(f->begin[s + 1] - f->begin[s]), size = f->start[s + 1] - f->start[s];
        int width = PADDED(own), height = width + PADDED(DIM*size);
        const int *row = f->row + f->start[s];
        double *xs = x + (ptrdiff_t)DIM*f->begin[s];
        for (i = 0; i < own; i++) z[i] = xs[i];
        for (; i < height; i++) z[i] = 0.0;
        forward(f->l + f->panel[s], z, width, height);
        for (i = 0; i < own; i++) xs[i] = z[i];
        for (i = 0; i < size; i++)
            for (r = 0; r < DIM; r++) x[(ptrdiff_t)DIM*row[i] + r] += z[width + DIM*i + r];
    }
    for (s = f->nodes - 1; s >= 0; s--) {
        int own = DIM*(f->begin[s + 1] - f->begin[s]), size = f->start[s + 1] - f->start[s];
        int width = PADDED(own), height = width + PADDED(DIM*size);
        const int *row = f->row + f->start[s];
        double *xs = x + (ptrdiff_t)DIM*f->begin[s];
        for (i = own; i < width; i++) z[i] = 0.0;
        for (i = 0; i < own; i++) z[i] = xs[i];
        for (i = 0; i < size; i++)
            for (r = 0; r < DIM; r++) z[width + DIM*i + r] = x[(ptrdiff_t)DIM*row[i] + r];
        for (i = width + DIM*size; i < height; i++) z[i] = 0.0;
        backward(f->l + f->panel[s], z, width, height);
        for (i = 0; i < own; i++) xs[i] = z[i];
    }
}
