/* Many runs of one model, each with parameters of its own: their rows at given times (codegen/event_driven_batch.py). */
#include <time.h>

#define LOOK 32 /* pieces between two looks at the clock */

#if HELD
#define FREE (N - MODEL_PIECES_HELD)
#else
#define FREE N
#endif

/* What a row has: x, l, columns of a trajectory, multipliers of the user's law, their integrals since the row before, two numbers. */
enum {
    ROW_X, ROW_L = ROW_X + N, ROW_MORE = ROW_L + M, ROW_OWN = ROW_MORE + RECORDS, ROW_STEP = ROW_OWN + SHOWN,
    ROW_ESTIMATE = ROW_STEP + (IMPULSES ? M : 0), ROW_RESIDUAL, ROW_WIDTH
};

@PIECE_CELLS@

long model_row_width(void) { return ROW_WIDTH; }
#if TANGENTS

/* Of the memory that derivatives take. */
long model_tangents_size(void) { return (long)sizeof(model_tangents); }
#endif

/* The value of a polynomial at s, term by term from the last: as whole runs have it. */
static double term_by_term(const double *c, int order, double s)
{
    double total = c[(long)order*ROWS];
    for (int k = order - 1; k >= 0; k--) {
        total *= s;
        total += c[(long)k*ROWS];
    }
    return total;
}

#if IMPULSES
/* The integral of the same from 0 to s. */
static double integral_of(const double *c, int order, double s)
{
    double total = c[(long)order*ROWS]/(order + 1);
    for (int k = order - 1; k >= 0; k--) {
        total *= s;
        total += c[(long)k*ROWS]/(k + 1);
    }
    return s*total;
}
#endif

/* How far a row is from its law where y depends on l. */
static double off_law(const model_pieces *s, const double *l, const double *y)
{
    double worst = 0;
#if FEED
    for (int i = 0; i < M; i++) {
        if (!feeds[i])
            continue;
        const double code = s->piece[AT_CODES + i];
        const double off = (code == 0 ? fabs(y[i]) : code*y[i] > 0 ? code*y[i] : 0)/max_of(s->piece[AT_SIZE_Y + i], NOTHING);
        const double below = lower[i] - l[i], above = l[i] - upper[i], beyond = below > above ? below : above;
        const double out = (beyond > 0 ? beyond : 0)/max_of(s->piece[AT_SIZE_L + i], NOTHING);
        worst = max_of(worst, max_of(off, out));
    }
#else
    UNUSED(s);
    UNUSED(l);
    UNUSED(y);
#endif
    return worst;
}

/* A row at time t of the last piece; the start of the run is one at t = 0. */
static void write_row(model_pieces *s, model_piece_cells *at, double t, double *row, signed char *codes)
{
    const double *c = s->piece + AT_C, begin = s->piece[AT_T], end = begin + s->piece[AT_TAU]*s->piece[AT_S];
    const double here = (t - begin)/s->piece[AT_TAU];
    for (int j = 0; j < N + M; j++)
        row[j] = term_by_term(c + j, s->order, here);
    if (t == end) /* what is held has jumped at an edge */
        memcpy(row, s->piece + AT_LAST, FREE*sizeof *row);
    if (t == 0) {
        memcpy(row, at->starts + at->cell*N, N*sizeof *row);
#if HELD
        memcpy(row + N - MODEL_PIECES_HELD, s->data, MODEL_PIECES_HELD*sizeof *row);
#endif
    }
    if (at->more || FEEDS) {
        const double before = t*(1 - SAME_TIME); /* at an edge a row has the values before it */
        records(s, &before, row, row + ROW_L, row + ROW_MORE);
#if REWRITTEN
        own_multipliers(s, &t, row, row + ROW_L, row + ROW_OWN);
#endif
    }
    row[ROW_ESTIMATE] = at->defect;
    row[ROW_RESIDUAL] = off_law(s, row + ROW_L, row + ROW_MORE);
    if (t != 0)
        at->worst[at->cell] = max_of(row[ROW_RESIDUAL], at->worst[at->cell]);
    for (int i = 0; i < M; i++)
        codes[i] = (signed char)s->piece[AT_CODES + i];
    if (t != 0) {
        at->defect = s->piece[AT_DEFECT];
#if IMPULSES
        for (int i = 0; i < M; i++) {
            const double part = s->piece[AT_IMPULSE + i] + s->piece[AT_TAU]*integral_of(c + L + i, s->order, here);
            const double now = at->until[i] + part;
            row[ROW_STEP + i] = now - at->told[i];
            at->told[i] = now;
        }
#endif
        return;
    }
    for (int i = 0; i < M; i++)
        codes[i] = NO_CODE;
}

/* The rows that the last piece has, of those that are asked for. */
static void write_rows(model_pieces *s, model_piece_cells *at)
{
    const double end = s->piece[AT_T] + s->piece[AT_TAU]*s->piece[AT_S];
    const long cell = at->cell;
    at->pieces[cell] += 1;
    at->events[cell] += s->piece[AT_EVENT] != 0;
    at->estimate[cell] = max_of(s->piece[AT_DEFECT], at->estimate[cell]);
    at->defect = max_of(at->defect, s->piece[AT_DEFECT]);
    for (; at->row < at->rows && at->times[at->row] <= end; at->row++) {
        const long row = cell*at->rows + at->row;
        write_row(s, at, at->times[at->row], at->kept + row*ROW_WIDTH, at->index + row*M);
        at->taken[cell] += at->times[at->row] != 0;
    }
#if IMPULSES
    const double whole = (end - s->piece[AT_T])/s->piece[AT_TAU];
    for (int i = 0; i < M; i++)
        at->until[i] += s->piece[AT_IMPULSE + i] + s->piece[AT_TAU]*integral_of(s->piece + AT_C + L + i, s->order, whole);
#endif
}

static int has_diverged(const model_pieces *s)
{
    for (int i = 0; i < N; i++)
        if (!(fabs(s->at.x[i]) <= WIDEST))
            return 1;
    return 0;
}

/* Begin with a cell; where its start is not a number, so is its set. */
static int begin_cell(model_pieces *s, const model_asked *of, model_piece_cells *at)
{
    at->begun = 1;
    at->row = at->made = 0;
    at->defect = 0;
    memset(at->until, 0, M*sizeof *at->until);
    memset(at->told, 0, M*sizeof *at->told);
    const int status = begin_run(s, of, at->values + at->cell*MODEL_PIECES_NP, 0, at->starts + at->cell*N);
#if TANGENTS
    begin_tangents(s, (model_tangents *)at->tangents);
#endif
    return status == MODEL_NOT_FINITE ? MODEL_BAD_PARAMETER : status == MODEL_OK && has_diverged(s) ? MODEL_NOT_FINITE : status;
}

/*
 * Runs of cells that differ in their parameters, from at->cell on, for about so many seconds: whether all are behind. Rows stay as they
 * were from where a run fails.
 */
int model_run_cells(model_pieces *s, const model_asked *of, model_piece_cells *at, double seconds)
{
    const clock_t first = clock();
    long count = 0;
    for (; at->cell < at->cells; at->cell++, at->begun = 0) {
        const long cell = at->cell;
        if (at->status[cell] != -1)
            continue;
        int status = at->begun ? MODEL_OK : begin_cell(s, of, at);
        while (status == MODEL_OK && s->at.t < at->t_end) {
            if (++count % LOOK == 0 && (double)(clock() - first) > seconds*CLOCKS_PER_SEC)
                return 0;
            status = at->made++ < at->most ? advance_piece(s) : MODEL_NOT_SOLVED;
#if TANGENTS
            if (status == MODEL_OK)
                status = follow_piece(
                    s, (model_tangents *)at->tangents, at->rows - at->row, at->times + at->row,
                    at->slopes + (cell*at->rows + at->row)*(N + M)*BY
                );
#endif
            if (status == MODEL_OK)
                write_rows(s, at);
            if (status == MODEL_OK && has_diverged(s))
                status = MODEL_NOT_FINITE;
        }
        at->failed_at[cell] = status == MODEL_OK ? NAN : s->at.t;
        at->status[cell] = (signed char)status;
    }
    return 1;
}
