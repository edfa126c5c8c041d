    struct {
        double E[MODEL_N], guess[MODEL_N], E_guess[MODEL_N], dz[MODEL_N]; /* guess: where nothing moves; |E| there */
#if AFFINE
        double E_0[MODEL_N]; /* E at z = 0, l = 0 */
#endif
#if EXPLICIT
        double given[MODEL_EXPLICIT]; /* the unknowns that their own rows give */
#endif
        double scale[MODEL_N], error_E[MODEL_N];
        int looked; /* whether the error bounds are those of (z, l) */
        int prepared; /* what is known of the matrices below */
#if !IDENTITY
        double E_z[MODEL_N*MODEL_N], lu[MODEL_N*MODEL_N], felt[MODEL_N], unit[MODEL_N], size[MODEL_N];
        int pivot[MODEL_N];
#endif
#if LAW
#if AFFINE
        double Y_0[MODEL_M];
#endif
        double Y[MODEL_M], b[MODEL_M], l[MODEL_M], v[MODEL_N], sum[MODEL_N];
        double terms[MODEL_M], w_max[MODEL_M], s_y[MODEL_M], error_Y[MODEL_M];
#if ROWS
        double E_l[MODEL_E_L], Y_z[MODEL_Y_Z]; /* nonzeros: by columns, by rows */
        double W[MODEL_ROWS*MODEL_ROWS], b_rows[MODEL_ROWS], l_rows[MODEL_ROWS], lower[MODEL_ROWS], upper[MODEL_ROWS];
        int rows[MODEL_ROWS];
        signed char code[MODEL_ROWS], place[MODEL_M];
#else
        double E_l[MODEL_N*MODEL_M], Y_z[MODEL_M*MODEL_N], W[MODEL_M*MODEL_M];
#if FEEDTHROUGH
        double Y_l[MODEL_M*MODEL_M];
#endif
#if !IDENTITY
        double S[MODEL_N*MODEL_M];
#endif
#endif
#endif
#if UNIT_ROWS
        double offset[MODEL_UNIT];
#if FOLLOW_ROWS
        signed char exact[MODEL_N];
#endif
#endif
#if NEARBY
        double z_0[MODEL_N], l_0[MODEL_M], step[MODEL_N + MODEL_M]; /* where a damped step starts, and the step */
#endif
#if LAW
        int free[MODEL_M]; /* rows coded 0 */
#endif
#if KEPT
        struct {
            double z[MODEL_N], residual;
            int iterations;
#if LAW
            double l[MODEL_M], y[MODEL_M];
            signed char code[MODEL_M];
#endif
        } best; /* an accepted iterate that may still improve */
#endif
    } newton;
