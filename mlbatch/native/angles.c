/* Cosines and sines of rotor words: those of numpy to the last bit of float32, or none.

   Source: reduction and polynomials of fdlibm (`e_rem_pio2.c`, `k_sin.c`, `k_cos.c`), which are
   right to a unit in the last place of a double. Nearly always that decides the float32 result;
   where it does not, numpy has to compute it. */
#include "native.h"

#if defined(__SSE2__)
#include <emmintrin.h>
#endif

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

#if defined(__SSE2__)
/* Both for two words at a time: the same operations on the same numbers. Returns a bit for each that
   numpy has to compute. */
static inline int pair_of(const int64_t *words, float *cosine, float *sine)
{
    const __m128d one = _mm_set1_pd(1.0), margin = _mm_set1_pd(MARGIN);
    /* An integer below 2**52 in the mantissa of a double that is larger by 2**52. */
    const __m128i ticks = _mm_and_si128(_mm_loadu_si128((const __m128i *)words),
                                        _mm_set1_epi64x(TICKS));
    const __m128d whole = _mm_castsi128_pd(
        _mm_or_si128(ticks, _mm_castpd_si128(_mm_set1_pd(0x1p52))));
    const __m128d angle =
        _mm_mul_pd(_mm_sub_pd(whole, _mm_set1_pd(0x1p52)), _mm_set1_pd(RADIANS));
    /* To the nearest integer; its bits are the lowest of the mantissa. */
    const __m128d large = _mm_set1_pd(0x1.8p52);
    const __m128d moved = _mm_add_pd(_mm_mul_pd(angle, _mm_set1_pd(QUARTERS)), large);
    const __m128d quarter = _mm_sub_pd(moved, large);
    const __m128i bits = _mm_castpd_si128(moved);
    const __m128d rest =
        _mm_sub_pd(_mm_sub_pd(angle, _mm_mul_pd(quarter, _mm_set1_pd(QUARTER))),
                   _mm_mul_pd(quarter, _mm_set1_pd(REST)));
    const __m128d square = _mm_mul_pd(rest, rest);
#define NEXT(tail, factor) _mm_add_pd(_mm_set1_pd(factor), _mm_mul_pd(square, tail))
    __m128d tail = _mm_set1_pd(-1.13596475577881948265e-11);
    tail = NEXT(tail, 2.08757232129817482790e-09);
    tail = NEXT(tail, -2.75573143513906633035e-07);
    tail = NEXT(tail, 2.48015872894767294178e-05);
    tail = NEXT(tail, -1.38888888888741095749e-03);
    tail = NEXT(tail, 4.16666666666666019037e-02);
    const __m128d along = _mm_sub_pd(
        one, _mm_sub_pd(_mm_mul_pd(_mm_set1_pd(0.5), square),
                        _mm_mul_pd(_mm_mul_pd(square, square), tail)));
    tail = _mm_set1_pd(1.58969099521155010221e-10);
    tail = NEXT(tail, -2.50507602534068634195e-08);
    tail = NEXT(tail, 2.75573137070700676789e-06);
    tail = NEXT(tail, -1.98412698298579493134e-04);
    tail = NEXT(tail, 8.33333333332248946124e-03);
    tail = NEXT(tail, -1.66666666666666324348e-01);
#undef NEXT
    const __m128d across = _mm_add_pd(rest, _mm_mul_pd(_mm_mul_pd(rest, square), tail));
    const __m128i ones = _mm_set1_epi64x(1);
    const __m128d is_odd =
        _mm_castsi128_pd(_mm_sub_epi64(_mm_setzero_si128(), _mm_and_si128(bits, ones)));
    const __m128d swapped = _mm_and_pd(is_odd, _mm_xor_pd(along, across));
    /* Bit 1 of quarter + 1, and of quarter, as signs. */
    const __m128i sign = _mm_set1_epi64x(INT64_MIN);
    const __m128i next = _mm_and_si128(_mm_slli_epi64(_mm_add_epi64(bits, ones), 62), sign);
    const __m128i own = _mm_and_si128(_mm_slli_epi64(bits, 62), sign);
    const __m128d x = _mm_xor_pd(_mm_xor_pd(along, swapped), _mm_castsi128_pd(next));
    const __m128d y = _mm_xor_pd(_mm_xor_pd(across, swapped), _mm_castsi128_pd(own));
    const __m128 is_sure = _mm_and_ps(
        _mm_cmpeq_ps(_mm_cvtpd_ps(_mm_sub_pd(x, margin)), _mm_cvtpd_ps(_mm_add_pd(x, margin))),
        _mm_cmpeq_ps(_mm_cvtpd_ps(_mm_sub_pd(y, margin)), _mm_cvtpd_ps(_mm_add_pd(y, margin))));
    const __m128 found = _mm_or_ps(_mm_and_ps(is_sure, _mm_cvtpd_ps(x)),
                                   _mm_andnot_ps(is_sure, _mm_set1_ps(2.0f)));
    _mm_storel_pi((__m64 *)cosine, found);
    _mm_storel_pi((__m64 *)sine, _mm_cvtpd_ps(y));
    return ~_mm_movemask_ps(is_sure) & 3;
}
#endif

/* Cosines and sines of (count,) rotor words; 2 as cosine where numpy has to compute both.
   Return the number of these. */
EXPORT int64_t mlbatch_angles(int64_t count, const int64_t *words, float *cosine, float *sine)
{
    int64_t left = 0, number = 0;
#if defined(__SSE2__)
    for (; number + 2 <= count; number += 2) {
        const int unsure = pair_of(words + number, cosine + number, sine + number);
        left += (unsure & 1) + (unsure >> 1);
    }
#endif
    for (; number < count; number++) {
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
