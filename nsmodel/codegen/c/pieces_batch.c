/* Many runs of one model, each with parameters of its own: their rows at given times (codegen/piece_batch.py). */
#include <time.h>

#define LOOK 32 /* pieces between two looks at the clock */
#define WIDEST 1e100 /* a state beyond this has diverged */

enum { OF_PIECES, OF_EVENTS, OF_ESTIMATE, OF_RESIDUAL, OF_FAILED, OF_ROWS, OF_UNIQUE, OF_COLUMNS };

/* What a row has: x, l, columns of a trajectory, multipliers of the user's law, their integrals since the row before, two numbers. */
enum {
    ROW_X, ROW_L = ROW_X + N, ROW_MORE = ROW_L + M, ROW_OWN = ROW_MORE + RECORDS, ROW_STEP = ROW_OWN + SHOWN,
    ROW_ESTIMATE = ROW_STEP + (IMPULSES ? M : 0), ROW_RESIDUAL, ROW_WIDTH
};

/* Where a call goes on. */
typedef struct {
    long cell, row, pieces;
    int begun;
    double worst; /* defect since the last row */
    double until[M + 1], told[M + 1]; /* integrals of l: to the end of the pieces, to the last row */
} model_batch;

long model_batch_size(void) { return (long)sizeof(model_batch); }

long model_row_width(void) { return ROW_WIDTH; }

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
static void write_row(model_pieces *s, model_batch *at, double t, int more, double *row, signed char *codes, double *totals)
{
    const double *c = s->piece + AT_C, begin = s->piece[AT_T], end = begin + s->piece[AT_TAU]*s->piece[AT_S];
    const double here = (t - begin)/s->piece[AT_TAU];
    for (int j = 0; j < N + M; j++)
        row[j] = term_by_term(c + j, s->order, here);
    if (more || FEEDS) {
        records(s, &t, row, row + ROW_L, row + ROW_MORE);
#if REWRITTEN
        own_multipliers(s, &t, row, row + ROW_L, row + ROW_OWN);
#endif
    }
    if (t == end)
        memcpy(row, s->piece + AT_LAST, N*sizeof *row);
    row[ROW_ESTIMATE] = at->worst;
    row[ROW_RESIDUAL] = off_law(s, row + ROW_L, row + ROW_MORE);
    totals[OF_RESIDUAL] = max_of(row[ROW_RESIDUAL], totals[OF_RESIDUAL]);
    for (int i = 0; i < M; i++)
        codes[i] = (signed char)s->piece[AT_CODES + i];
#if IMPULSES
    for (int i = 0; i < M; i++) {
        const double part = s->piece[AT_TAU]*integral_of(c + L + i, s->order, here), now = at->until[i] + (s->piece[AT_IMPULSE + i] + part);
        row[ROW_STEP + i] = now - at->told[i];
        at->told[i] = now;
    }
#endif
    if (t == 0) {
        start(s, row);
#if HELD
        memcpy(row + N - MODEL_PIECES_HELD, s->data, MODEL_PIECES_HELD*sizeof *row);
#endif
        for (int i = 0; i < M; i++)
            codes[i] = NO_CODE;
    }
    else
        at->worst = s->piece[AT_DEFECT];
}

/* The rows that the last piece has, of those that are asked for. */
static void write_rows(model_pieces *s, model_batch *at, const double *times, long rows, int more, double *out, signed char *codes, double *totals)
{
    const double end = s->piece[AT_T] + s->piece[AT_TAU]*s->piece[AT_S];
    totals[OF_PIECES] += 1;
    totals[OF_EVENTS] += s->piece[AT_EVENT] != 0;
    totals[OF_ESTIMATE] = max_of(s->piece[AT_DEFECT], totals[OF_ESTIMATE]);
    if (!(at->row < rows && times[at->row] == 0))
        at->worst = max_of(at->worst, s->piece[AT_DEFECT]);
    for (; at->row < rows && times[at->row] <= end; at->row++) {
        write_row(s, at, times[at->row], more, out + at->row*ROW_WIDTH, codes + at->row*M, totals);
        at->worst = max_of(at->worst, s->piece[AT_DEFECT]);
    }
#if IMPULSES
    const double whole = (end - s->piece[AT_T])/s->piece[AT_TAU];
    for (int i = 0; i < M; i++)
        at->until[i] += s->piece[AT_IMPULSE + i] + s->piece[AT_TAU]*integral_of(s->piece + AT_C + L + i, s->order, whole);
#endif
}

/* Begin with the next cell. */
static int begin_cell(model_pieces *s, model_batch *at, const model_asked *of, const double *p, double *totals)
{
    const long cell = at->cell;
    memset(at, 0, sizeof *at);
    at->cell = cell;
    at->begun = 1;
    memset(totals, 0, OF_COLUMNS*sizeof *totals);
    totals[OF_FAILED] = NAN;
    const int status = begin_run(s, of, p, 0);
    for (int i = 0; i < N && status == MODEL_OK; i++)
        if (!(fabs(s->at.x[i]) <= WIDEST))
            return MODEL_NOT_FINITE;
    return status;
}

/*
 * Runs to t_end of cells that differ in their parameters p, from at->cell on, for about so many seconds; how many are behind. Of each
 * a status; totals; rows at increasing times, which stay as they were from where a run fails; codes of the rows.
 */
long model_cells(model_pieces *s, model_batch *at, const model_asked *of, const double *p, long cells, double t_end, const double *times,
                 long rows, int more, long most, double seconds, double *out, signed char *codes, int *statuses, double *totals)
{
    const clock_t first = clock();
    long count = 0;
    for (; at->cell < cells; at->cell++, at->begun = 0) {
        const long cell = at->cell;
        double *const of_cell = totals + cell*OF_COLUMNS;
        int status = at->begun ? MODEL_OK : begin_cell(s, at, of, p + cell*MODEL_PIECES_NP, of_cell);
        while (status == MODEL_OK && s->at.t < t_end) {
            if (++count % LOOK == 0 && (double)(clock() - first) > seconds*CLOCKS_PER_SEC)
                return at->cell;
            status = at->pieces++ < most ? advance_piece(s) : MODEL_NOT_SOLVED;
            if (status == MODEL_OK)
                write_rows(s, at, times, rows, more, out + cell*rows*ROW_WIDTH, codes + cell*rows*M, of_cell);
            for (int i = 0; i < N && status == MODEL_OK; i++)
                if (!(fabs(s->at.x[i]) <= WIDEST))
                    status = MODEL_NOT_FINITE;
        }
        if (status != MODEL_OK)
            of_cell[OF_FAILED] = s->at.t;
        of_cell[OF_ROWS] = (double)at->row;
        of_cell[OF_UNIQUE] = s->at.unique[2];
        statuses[cell] = status;
    }
    return at->cell;
}
