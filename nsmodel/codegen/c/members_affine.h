    struct {
        double lu[MODEL_LINEAR*MODEL_LINEAR]; /* a matrix, then its factors L and U, or the columns U S of its SVD */
#if !REGULAR_SETS
        double v[MODEL_LINEAR*MODEL_LINEAR];  /* the columns V of the SVD, or an inverse */
        double rhs[MODEL_LINEAR], start[MODEL_LINEAR];
#endif
        double x[MODEL_LINEAR];
        double rows[MODEL_LINEAR], columns[MODEL_LINEAR]; /* powers of 2 in whose units a matrix is well scaled */
        int pivot[MODEL_LINEAR];
    } linear;
#if AFFINE_PROBLEM
    struct {
        double block[MODEL_ROWS*MODEL_ROWS]; /* W's free rows and columns, or W in other units, or a Jacobian */
        double l[MODEL_ROWS], y[MODEL_ROWS], x[MODEL_ROWS];
        double w_max[MODEL_ROWS], s_y[MODEL_ROWS];
        double best[MODEL_ROWS]; /* the best answer so far, with its index set and residual */
        double residual;
        int free[MODEL_ROWS];
        signed char code[MODEL_ROWS], best_code[MODEL_ROWS];
    } affine;
#endif
#if INDEX_SETS
    struct {
        int rows, changes;                         /* rows that have a choice, how many of them differ from ``last`` */
        int row[MODEL_ROWS], position[MODEL_ROWS]; /* the rows that have a choice, which of them differ */
        signed char last[MODEL_ROWS], choice[MODEL_ROWS];
    } sets;
#endif
#if PIVOTING
    struct {
        double scale[MODEL_ROWS], b[MODEL_ROWS], lower[MODEL_ROWS], upper[MODEL_ROWS]; /* the problem in other units */
        double l[MODEL_ROWS], offset[MODEL_ROWS]; /* l = offset + the sum of sign z over the columns */
        double sign[MODEL_LEMKE], q[MODEL_LEMKE], value[MODEL_LEMKE], entering[MODEL_LEMKE];
        double regular;
        int n, size; /* columns of z, and with the slacks of upper bounds */
        int column[MODEL_LEMKE], basis[MODEL_LEMKE], rows[MODEL_LEMKE];
    } lemke;
#endif
#if CURVED
    struct {
        double l[MODEL_ROWS], c[MODEL_ROWS], u[MODEL_ROWS], F[MODEL_ROWS], step[MODEL_ROWS], trial[MODEL_ROWS];
#if FRICTION
        double swept[MODEL_ROWS], added; /* to the diagonal of W */
        int choice[MODEL_ROWS], associated; /* whether the law is taken without ŷ */
#endif
        int width[MODEL_ROWS];
    } semismooth;
#endif
