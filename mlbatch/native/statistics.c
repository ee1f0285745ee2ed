/* Statistics of the columns of a scan, by sensor: `decode/coverage.py`. */
#include <string.h>

#include "native.h"

enum { NUMBER, GAP, ONCE, AGAIN, STAMP, SECTOR, FIGURES };

/* Rotor positions are a share of `positions`; 0: rotor words, 2**32 ticks a revolution. */
static int64_t sector_of(int64_t encoder, int64_t positions, int64_t sectors)
{
    if (positions)
        return encoder * sectors / positions;
    return (encoder & INT64_C(0xFFFFFFFF)) * sectors >> 32;
}

/* Columns, largest gap, sectors entered and sectors entered again of each sensor: the first four
   of its figures (sensors, FIGURES); entered: scratch (sensors, sectors). Return 1 if a position
   is outside of the revolution, so that numpy has to compute them. */
EXPORT int64_t mlbatch_statistics(int64_t columns, const int64_t *stamp_ns, const int64_t *sensor,
                                  const int64_t *encoder, int64_t sensors, int64_t sectors,
                                  const int64_t *positions, int64_t *entered, int64_t *figures)
{
    memset(figures, 0, (size_t)(sensors * FIGURES) * sizeof *figures);
    memset(entered, 0, (size_t)(sensors * sectors) * sizeof *entered);
    for (int64_t column = 0; column < columns; column++) {
        const int64_t number = sensor[column];
        if (encoder[column] < 0 && positions[number])
            return 1;
        const int64_t sector = sector_of(encoder[column], positions[number], sectors);
        if (sector < 0 || sector >= sectors)
            return 1;
        int64_t *own = figures + number * FIGURES;
        if (own[NUMBER] == 0) {
            entered[number * sectors + sector]++;
        } else {
            entered[number * sectors + sector] += sector != own[SECTOR];
            const int64_t gap = stamp_ns[column] - own[STAMP];
            if (gap > own[GAP])
                own[GAP] = gap;
        }
        own[NUMBER]++;
        own[STAMP] = stamp_ns[column];
        own[SECTOR] = sector;
    }
    for (int64_t number = 0; number < sensors; number++)
        for (int64_t sector = 0; sector < sectors; sector++) {
            const int64_t times = entered[number * sectors + sector];
            figures[number * FIGURES + ONCE] += times > 0;
            figures[number * FIGURES + AGAIN] += times > 1;
        }
    return 0;
}
