/* Whole runs. */

#ifdef __GNUC__
#pragma GCC visibility push(default)
#endif

long model_size(void) { return (long)sizeof(model_pieces); }

/* What a piece takes in a list of them. */
long model_width(int order) { return AT_C + (long)(order + 1)*ROWS; }

/* Begin at the start of the model; residuals: see the struct; known times, 0 the first, and what is held after each. */
int model_begin(model_pieces *s, double rtol, const double *atol, int residuals, const double *known, const double *data, long knowns)
{
    double x[N];
    const int status = model_pieces_init(s, rtol);
    if (status == MODEL_BAD_ARITHMETIC)
        return status;
    memcpy(s->atol, atol, sizeof s->atol);
#if STIFF
    s->residuals = residuals;
#else
    UNUSED(residuals);
    s->leaves = 1;
#endif
    start(s, x);
#if HELD
    s->known_at = known;
    s->data = data;
    s->knowns = knowns;
    memcpy(x + N - MODEL_PIECES_HELD, data, MODEL_PIECES_HELD*sizeof *data);
#else
    UNUSED(known);
    UNUSED(data);
    UNUSED(knowns);
#endif
    return model_pieces_set_state(s, 0, x);
}

/* Pieces until a time, as many as there is room for; how many. *status is that of the piece that could not be made. */
long model_many(model_pieces *s, double until, long room, double *out, int *status)
{
    long count = 0;
    const long width = model_width(s->order);
    *status = MODEL_OK;
    while (count < room && s->at.t < until) {
        if ((*status = advance_piece(s)) != MODEL_OK)
            break;
        memcpy(out + width*count++, s->piece, width*sizeof *out);
    }
    return count;
}

/* What a trajectory tells beside: of each row t, x, l. */
void model_told(const model_pieces *s, long rows, const double *given, double *out)
{
    const long width = 1 + N + M;
    for (long r = 0; r < rows; r++)
        records(s, given + r*width, given + r*width + 1, given + r*width + 1 + N, out + r*RECORDS);
}

#ifdef __GNUC__
#pragma GCC visibility pop
#endif
