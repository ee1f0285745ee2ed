/* The loops of `decode.c` for vectors of eight numbers, which `mlbatch_decode` takes where the
   processor has them. */
#include "native.h"

#if defined(MLBATCH_WIDE)
#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx2"))), apply_to = function)
#else
#pragma GCC target("avx2")
#endif

#define LANES 8
#include "decode.c"

#if defined(__clang__)
#pragma clang attribute pop
#endif
#endif
