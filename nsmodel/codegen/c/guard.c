#if defined __FAST_MATH__ || defined __ASSOCIATIVE_MATH__ || defined __RECIPROCAL_MATH__
#error "compile without -ffast-math, -Ofast and -funsafe-math-optimizations: a certificate needs its sums as they are written"
#endif
#if defined __FINITE_MATH_ONLY__ && __FINITE_MATH_ONLY__
#error "compile without -ffinite-math-only: it removes the checks for NaN that a certificate needs"
#endif

/* Whether the compiler has left NaN and sums as they are written: not all tell by a macro. */
static int is_sound(void)
{
    volatile double zero = 0, one = 1, little = 1e-25;
    const double none = zero/zero, a = one, b = little;
    return !(none - none == 0) && !(none <= a) && (a + b) - a == 0;
}
