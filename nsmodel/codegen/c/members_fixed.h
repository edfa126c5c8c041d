    struct {
#if LENGTHS
        struct {
            double h, E_z[MODEL_N*MODEL_N], inverse[MODEL_N*MODEL_N], unit_z[MODEL_N], unit_size_E[MODEL_N];
#if LAW
            double E_l[MODEL_N*MODEL_M], Y_z[MODEL_M*MODEL_N], Y_l[MODEL_M*MODEL_M], Z[MODEL_N*MODEL_M];
            double output_map[MODEL_M*MODEL_M];
#if CURVED
            double output_max[MODEL_M];
#else
            double w_root[MODEL_M];
#endif
            double unit_l[MODEL_M], unit_size_Y[MODEL_M];
#endif
            long used; /* when its length was last taken up */
        } lengths[MODEL_LENGTHS]; /* the matrices of the lengths of steps used last */
        int length, formed; /* the one in use, and how many there are */
        long turn;
#endif
        double E_0[MODEL_N], z_0[MODEL_N], E[MODEL_N], scale[MODEL_N], error_E[MODEL_N];
        double step[MODEL_N], dz[MODEL_N], felt_z[MODEL_N], probe_E[MODEL_N], passed_E[MODEL_N]; /* corrections */
#if LAW
        double Y_0[MODEL_M], b[MODEL_M], Y[MODEL_M], error_Y[MODEL_M], terms[MODEL_M];
        double dl[MODEL_M], felt_l[MODEL_M], probe_Y[MODEL_M], passed_Y[MODEL_M];
#if CURVED
        double s_y[MODEL_M];
#endif
#if !ENUMERATED
        double l[MODEL_M];
#endif
        signed char code[MODEL_M];
#endif
#if SETTLED
        signed char called[MODEL_M]; /* the index set that is called for */
#endif
#if FIXED_MAPS
        double block[MODEL_M * MODEL_M];
        struct {
            double inverse[MODEL_M * MODEL_M], offset[MODEL_M], at_bound[MODEL_M];
            int n, free[MODEL_M];
            signed char code[MODEL_M];
#if LENGTHS
            int length;
#endif
            signed char fragile, singular; /* whether W keeps too little of the whole system there, or does not tell l */
        } maps[MODEL_MAPS]; /* of the index sets met last */
        int filled, oldest, current;
#endif
        int looked; /* whether the error bounds are those of (z, l) */
#if FOLLOW_ROWS
        signed char exact[MODEL_N];
#endif
    } fixed;
