/* Cosines and sines of rotor words: those of numpy to the last bit of float32, or none.

   Source: reduction and polynomials of fdlibm (`e_rem_pio2.c`, `k_sin.c`, `k_cos.c`), which are
   right to a unit in the last place of a double. Nearly always that decides the float32 result;
   where it does not, numpy has to compute it. */
#include "native.h"

#define TICKS UINT64_C(0xFFFFFFFF)
#define RADIANS (2 * 3.141592653589793 / 4294967296.0)
#define QUARTERS (2 / 3.141592653589793)
/* A quarter of a revolution in two parts: products of the first with numbers below 2**20 are
   exact. */
#define QUARTER 1.57079632673412561417e00
#define REST 6.07710050650619224932e-11
/* More than the errors of these polynomials and of numpy (4 units in the last place) together. */
#define MARGIN 0x1p-49

/* Two numbers at a time, and their bits. */
typedef double Reals __attribute__((vector_size(16)));
typedef uint64_t Bits __attribute__((vector_size(16)));
typedef float Singles __attribute__((vector_size(8)));
typedef int32_t Choice __attribute__((vector_size(8)));

static inline Reals cosine_of(Reals square)
{
    Reals tail = 2.08757232129817482790e-09 + square * -1.13596475577881948265e-11;
    tail = -2.75573143513906633035e-07 + square * tail;
    tail = 2.48015872894767294178e-05 + square * tail;
    tail = -1.38888888888741095749e-03 + square * tail;
    tail = 4.16666666666666019037e-02 + square * tail;
    return 1.0 - (0.5 * square - square * square * tail);
}

static inline Reals sine_of(Reals angle, Reals square)
{
    Reals tail = -2.50507602534068634195e-08 + square * 1.58969099521155010221e-10;
    tail = 2.75573137070700676789e-06 + square * tail;
    tail = -1.98412698298579493134e-04 + square * tail;
    tail = 8.33333333332248946124e-03 + square * tail;
    tail = -1.66666666666666324348e-01 + square * tail;
    return angle + angle * square * tail;
}

/* The same float32 whatever the error. */
static inline Choice is_sure(Reals value)
{
    return __builtin_convertvector(value - MARGIN, Singles)
        == __builtin_convertvector(value + MARGIN, Singles);
}

/* Cosines and sines of two words. Return how many numpy has to compute. */
static inline int pair_of(const int64_t *words, float *cosine, float *sine)
{
    const Bits mantissa = (Bits)((Reals){0} + 0x1p52);
    Bits ticks;
    memcpy(&ticks, words, sizeof ticks);
    /* An integer below 2**52 in the mantissa of a double that is larger by 2**52. */
    const Reals angle = ((Reals)((ticks & TICKS) | mantissa) - 0x1p52) * RADIANS;
    /* To the nearest integer; its bits are the lowest of the mantissa. */
    const Reals moved = angle * QUARTERS + 0x1.8p52;
    const Reals quarter = moved - 0x1.8p52;
    const Bits bits = (Bits)moved;
    const Reals rest = (angle - quarter * QUARTER) - quarter * REST;
    const Reals square = rest * rest;
    const Bits along = (Bits)cosine_of(square), across = (Bits)sine_of(rest, square);
    /* In odd quarters one is the other; bit 1 of quarter + 1, and of quarter, as signs. */
    const Bits swapped = -(bits & 1) & (along ^ across);
    const Reals x = (Reals)(along ^ swapped ^ (((bits + 1) & 2) << 62));
    const Reals y = (Reals)(across ^ swapped ^ ((bits & 2) << 62));
    const Choice sure = is_sure(x) & is_sure(y);
    const Singles sines = __builtin_convertvector(y, Singles);
    Singles cosines = __builtin_convertvector(x, Singles);
    /* No cosine is 2. */
    const Choice none = (Choice)((Singles){0} + 2.0f);
    cosines = (Singles)(((Choice)cosines & sure) | (none & ~sure));
    memcpy(cosine, &cosines, sizeof cosines);
    memcpy(sine, &sines, sizeof sines);
    return 2 + sure[0] + sure[1];
}

/* Cosines and sines of (count,) rotor words; 2 as cosine where numpy has to compute both.
   Return the number of these. */
EXPORT int64_t mlbatch_angles(int64_t count, const int64_t *words, float *cosine, float *sine)
{
    int64_t left = 0, number = 0;
    for (; number + 2 <= count; number += 2)
        left += pair_of(words + number, cosine + number, sine + number);
    if (number < count) {
        const int64_t last[] = {words[number], words[number]};
        float cosines[2], sines[2];
        left += pair_of(last, cosines, sines) / 2;
        cosine[number] = cosines[0];
        sine[number] = sines[0];
    }
    return left;
}
