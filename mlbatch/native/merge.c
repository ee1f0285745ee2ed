/* Columns of all sensors in one order, and their figures: `batching/merge.py`. */
#include <string.h>

#include "native.h"

enum { MOST_SENSORS = 256 };
/* Figures of a sensor in a window: columns, largest gap, sectors entered, sectors entered again,
   first and last stamp; then the sector of the last column. */
enum { NUMBER, GAP, ONCE, AGAIN, FIRST, LAST, SECTOR, FIGURES };

/* Whether the columns of the parts of one sensor are in the order of their stamps. */
static int is_sorted(const Part *parts, int64_t begin, int64_t end)
{
    int64_t last = INT64_MIN;
    for (const Part *part = parts + begin; part < parts + end; part++)
        for (int64_t column = 0; column < part->columns; column++) {
            if (part->stamp_ns[column] < last)
                return 0;
            last = part->stamp_ns[column];
        }
    return 1;
}

/* Stamp of the next column of a sensor, INT64_MAX after the last one; moves on to its part. */
static inline int64_t head_of(const Part *parts, int64_t *next, int64_t end, int64_t *at)
{
    while (*next < end && *at == parts[*next].columns) {
        ++*next;
        *at = 0;
    }
    return *next < end ? parts[*next].stamp_ns[*at] : INT64_MAX;
}

/* Merge the columns before `until_ns` by stamp, then by sensor, then in their order. Parts come by
   sensor; taken (parts,): columns taken of each. Return the number of columns, -1 if those of a
   sensor are not in order, or are of more than MOST_SENSORS. */
EXPORT int64_t mlbatch_merge(int64_t part_count, const Part *parts, int64_t until_ns,
                             int64_t *taken, int64_t *stamp_ns, int64_t *sensor,
                             int64_t *ring_index, int64_t *encoder)
{
    /* Of each sensor: its next column, the end of its parts, and the stamp there. */
    int64_t next[MOST_SENSORS], end[MOST_SENSORS], at[MOST_SENSORS], head[MOST_SENSORS];
    int64_t sensors = 0, count = 0;
    for (int64_t part = 0; part < part_count; part++) {
        taken[part] = 0;
        if (part == 0 || parts[part].sensor != parts[part - 1].sensor) {
            if (sensors == MOST_SENSORS)
                return -1;
            next[sensors++] = part;
        }
        end[sensors - 1] = part + 1;
    }
    for (int64_t one = 0; one < sensors; one++) {
        if (!is_sorted(parts, next[one], end[one]))
            return -1;
        at[one] = 0;
        head[one] = head_of(parts, next + one, end[one], at + one);
    }
    while (sensors) {
        /* The sensor with the smallest stamp, and the stamp at which another one comes first. */
        int64_t best = 0, smallest = head[0], limit = until_ns;
        for (int64_t one = 1; one < sensors; one++) {
            if (head[one] < smallest) {
                /* The one before has a lower number, so that it comes first again when equal. */
                limit = smallest;
                smallest = head[one];
                best = one;
            } else if (head[one] < limit) {
                limit = head[one] + 1;
            }
        }
        if (smallest >= until_ns)
            break;
        if (limit > until_ns)
            limit = until_ns;
        const Part *part = parts + next[best];
        const int64_t columns = part->columns;
        int64_t place = at[best];
        do {
            stamp_ns[count] = part->stamp_ns[place];
            sensor[count] = part->sensor;
            ring_index[count] = part->ring_index[place];
            encoder[count] = part->encoder[place];
            count++;
            place++;
        } while (place < columns && part->stamp_ns[place] < limit);
        taken[next[best]] = at[best] = place;
        head[best] = head_of(parts, next + best, end[best], at + best);
    }
    return count;
}

/* Rotor positions are a share of `positions`, and those beyond it are at its ends; 0: rotor words,
   2**32 ticks per revolution. */
static int64_t sector_of(int64_t encoder, int64_t positions, int64_t sectors)
{
    if (!positions)
        return (encoder & INT64_C(0xFFFFFFFF)) * sectors >> 32;
    if (encoder < 0)
        return 0;
    return encoder < positions ? encoder * sectors / positions : sectors - 1;
}

/* Figures (windows, sensors, FIGURES) of the columns of some windows; ends (windows,): column
   after the last of each; positions (sensors,): see `sector_of`; entered (sensors, sectors):
   scratch. */
EXPORT void mlbatch_figures(int64_t windows, const int64_t *ends, const int64_t *stamp_ns,
                            const int64_t *sensor, const int64_t *encoder, int64_t sensors,
                            const int64_t *positions, int64_t sectors, int64_t *entered,
                            int64_t *figures)
{
    memset(figures, 0, (size_t)(windows * sensors * FIGURES) * sizeof *figures);
    int64_t column = 0;
    for (int64_t window = 0; window < windows; window++, figures += sensors * FIGURES) {
        memset(entered, 0, (size_t)(sensors * sectors) * sizeof *entered);
        for (; column < ends[window]; column++) {
            const int64_t number = sensor[column];
            const int64_t sector = sector_of(encoder[column], positions[number], sectors);
            int64_t *own = figures + number * FIGURES;
            if (own[NUMBER] == 0) {
                own[FIRST] = stamp_ns[column];
                entered[number * sectors + sector]++;
            } else {
                entered[number * sectors + sector] += sector != own[SECTOR];
                const int64_t gap = stamp_ns[column] - own[LAST];
                if (gap > own[GAP])
                    own[GAP] = gap;
            }
            own[NUMBER]++;
            own[LAST] = stamp_ns[column];
            own[SECTOR] = sector;
        }
        for (int64_t number = 0; number < sensors; number++)
            for (int64_t sector = 0; sector < sectors; sector++) {
                const int64_t times = entered[number * sectors + sector];
                figures[number * FIGURES + ONCE] += times > 0;
                figures[number * FIGURES + AGAIN] += times > 1;
            }
    }
}
