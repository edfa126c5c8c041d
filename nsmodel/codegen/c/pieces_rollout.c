/* Whole runs. */

#ifdef __GNUC__
#pragma GCC visibility push(default)
#endif

long model_size(void) { return (long)sizeof(model_pieces); }

/* What a piece takes in a list of them. */
long model_width(int order) { return AT_C + (long)(order + 1)*ROWS; }

/* What a run is asked for. */
@ASKED@

/* Begin with these parameters, at the states from;
   unique: the parameters are known to let x be the only one in all modes. */
static int begin_run(model_pieces *s, const model_asked *of, const double *p, int unique, const double *from)
{
    double x[N];
    int status = clear(s, of->rtol);
    if (status != MODEL_OK)
        return status;
    memcpy(s->atol, of->atol, sizeof s->atol);
#if STIFF
    s->residuals = (int)of->residuals;
#else
    s->leaves = 1;
#endif
#if PARAMETERS
    memcpy(s->p, p, sizeof s->p);
#else
    UNUSED(p);
#endif
    memcpy(x, from, sizeof x);
#if HELD
    s->known_at = of->known;
    s->data = of->data;
    s->knowns = of->knowns;
    memcpy(x + N - MODEL_PIECES_HELD, of->data, MODEL_PIECES_HELD*sizeof *x);
#endif
    status = take_parameters(s);
#if JUDGED
    s->unique |= unique;
#else
    UNUSED(unique);
#endif
    if (status == MODEL_OK && !all_finite(N, x))
        status = MODEL_NOT_FINITE;
    return status == MODEL_OK ? begin_at(s, 0, x) : (s->status = status);
}

int model_begin(model_pieces *s, const model_asked *of, const double *p, int unique, const double *from)
{
    return begin_run(s, of, p, unique, from);
}

#if PARAMETERS
/* Whether the code is for these parameters too: a status. */
int model_takes(model_pieces *s, const double *p)
{
    const int status = clear(s, ROUGHEST);
    memcpy(s->p, p, sizeof s->p);
    return status == MODEL_OK ? take_parameters(s) : status;
}

#endif

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
