/* Cosines and sines of rotor words: those of numpy to the last bit of float32, or none.

   Source: reduction and polynomials of fdlibm (`e_rem_pio2.c`, `k_sin.c`, `k_cos.c`), which are
   right to a unit in the last place of a double. Nearly always that decides the float32 result;
   where it does not, numpy has to compute it. */
#include "native.h"

#define TICKS INT64_C(0xFFFFFFFF)
#define RADIANS (2 * 3.141592653589793 / 4294967296.0)
#define QUARTERS (2 / 3.141592653589793)
/* A quarter of a revolution in two parts: products of the first with numbers below 2**20 are
   exact. */
#define QUARTER 1.57079632673412561417e00
#define REST 6.07710050650619224932e-11
/* More than the errors of these polynomials and of numpy (4 units in the last place) together. */
#define MARGIN 0x1p-49

static double cosine_of(double angle)
{
    const double square = angle * angle;
    const double tail = square
        * (2.48015872894767294178e-05
           + square
               * (-2.75573143513906633035e-07
                  + square * (2.08757232129817482790e-09 + square * -1.13596475577881948265e-11)));
    return 1.0
        - (0.5 * square
           - square * square * (4.16666666666666019037e-02
                                + square * (-1.38888888888741095749e-03 + tail)));
}

static double sine_of(double angle)
{
    const double square = angle * angle;
    const double tail = square
        * (-1.98412698298579493134e-04
           + square
               * (2.75573137070700676789e-06
                  + square * (-2.50507602534068634195e-08 + square * 1.58969099521155010221e-10)));
    return angle
        + angle * square
        * (-1.66666666666666324348e-01 + square * (8.33333333332248946124e-03 + tail));
}

/* Cosines and sines of (count,) rotor words; 2 as cosine where numpy has to compute both.
   Return the number of these. */
EXPORT int64_t mlbatch_angles(int64_t count, const int64_t *words, float *cosine, float *sine)
{
    int64_t left = 0;
    for (int64_t number = 0; number < count; number++) {
        const double angle = (double)(words[number] & TICKS) * RADIANS;
        const int32_t quarter = (int32_t)(angle * QUARTERS + 0.5);
        const double rest = (angle - quarter * QUARTER) - quarter * REST;
        const double along = cosine_of(rest), across = sine_of(rest);
        double own_cosine = quarter & 1 ? across : along;
        double own_sine = quarter & 1 ? along : across;
        if ((quarter + 1) & 2)
            own_cosine = -own_cosine;
        if (quarter & 2)
            own_sine = -own_sine;
        const int is_sure = (float)(own_cosine - MARGIN) == (float)(own_cosine + MARGIN)
            && (float)(own_sine - MARGIN) == (float)(own_sine + MARGIN);
        /* No cosine is 2. */
        cosine[number] = is_sure ? (float)own_cosine : 2.0f;
        sine[number] = (float)own_sine;
        left += !is_sure;
    }
    return left;
}
