/* Points of decoded clouds: from the rows of a message to packets of columns.

   The same values as `ros/pointcloud2.py` and `ros/point_packets.py` compute by numpy. */
#include <math.h>
#include <string.h>

#include "native.h"

/* Points that are read together; their values stay in the first cache. */
enum { TOGETHER = 256 };
/* sensor_msgs/PointField. */
enum { INT8 = 1, UINT8, INT16, UINT16, INT32, UINT32, FLOAT32, FLOAT64 };
enum { AXES = 3, REALS = 4 };
/* Runs of a cloud that are followed at once. */
enum { MOST_RUNS = 512 };

/* -- reading ----------------------------------------------------------------------------------- */

/* Numbers of one type that are `step` bytes apart, as float32. */
#define READ(type) \
    for (int64_t point = 0; point < count; point++) { \
        type value; \
        memcpy(&value, from + point * step, sizeof value); \
        out[point] = (float)value; \
    }

static void read_reals(const uint8_t *from, int64_t step, int64_t type, int64_t count, float *out)
{
    switch (type) {
    case INT8: READ(int8_t) break;
    case UINT8: READ(uint8_t) break;
    case INT16: READ(int16_t) break;
    case UINT16: READ(uint16_t) break;
    case INT32: READ(int32_t) break;
    case UINT32: READ(uint32_t) break;
    case FLOAT32: READ(float) break;
    case FLOAT64: READ(double) break;
    default: memset(out, 0, (size_t)count * sizeof *out);
    }
}

/* Fields of 1, 2, 4 or 8 bytes that are `step` bytes apart; chosen: which points, or NULL. */
#define COPY(type) \
    if (chosen) \
        for (int64_t point = 0; point < count; point++) \
            memcpy(out + point * (int64_t)sizeof(type), from + chosen[point] * step, \
                   sizeof(type)); \
    else \
        for (int64_t point = 0; point < count; point++) \
            memcpy(out + point * (int64_t)sizeof(type), from + point * step, sizeof(type));

static void copy_field(const uint8_t *from, int64_t step, int64_t bytes, const int64_t *chosen,
                       int64_t count, uint8_t *out)
{
    switch (bytes) {
    case 1: COPY(uint8_t) break;
    case 2: COPY(uint16_t) break;
    case 4: COPY(uint32_t) break;
    default: COPY(uint64_t)
    }
}

/* Clear the mark of points whose time is infinite or not a number. */
static void check_times(const uint8_t *from, int64_t step, int64_t type, int64_t count,
                        uint8_t *keep)
{
    if (type == FLOAT32)
        for (int64_t point = 0; point < count; point++) {
            uint32_t bits;
            memcpy(&bits, from + point * step, sizeof bits);
            keep[point] &= (bits & UINT32_C(0x7F800000)) != UINT32_C(0x7F800000);
        }
    else if (type == FLOAT64)
        for (int64_t point = 0; point < count; point++) {
            uint64_t bits;
            memcpy(&bits, from + point * step, sizeof bits);
            keep[point] &= (bits & UINT64_C(0x7FF0000000000000)) != UINT64_C(0x7FF0000000000000);
        }
}

static int64_t count_marks(const uint8_t *marks, int64_t count)
{
    int64_t total = 0;
    for (int64_t point = 0; point < count; point++)
        total += marks[point];
    return total;
}

/* Read the points that have a place and a finite time.

   rows: of `step` bytes. real_at, real_type (4,): x, y, z, intensity; type 0: none. time_type: of
   field 0. field_at, field_bytes (fields,): copied as they are to the arrays `out`. reals (4, room).
   Return the number of these points; placed: of points that have a place. */
EXPORT int64_t mlbatch_cloud_points(int64_t count, const uint8_t *rows, int64_t step,
                              const int64_t *real_at, const int64_t *real_type, int64_t time_type,
                              int64_t fields, const int64_t *field_at, const int64_t *field_bytes,
                              int64_t room, float *reals, uint8_t *const *out, int64_t *placed)
{
    _Alignas(64) float values[REALS][TOGETHER];
    _Alignas(64) uint8_t keep[TOGETHER];
    int64_t chosen[TOGETHER];
    int64_t kept = 0;
    *placed = 0;
    for (int64_t begin = 0; begin < count; begin += TOGETHER, rows += TOGETHER * step) {
        const int64_t some = count - begin < TOGETHER ? count - begin : TOGETHER;
        for (int64_t real = 0; real < REALS; real++)
            read_reals(rows + real_at[real], step, real_type[real], some, values[real]);
        for (int64_t point = 0; point < some; point++) {
            const float x = values[0][point], y = values[1][point], z = values[2][point];
            const float squared = x * x + y * y + z * z;
            keep[point] = (squared > 0.0f) & (squared < INFINITY);
            const float intensity = values[AXES][point];
            values[AXES][point] = intensity - intensity == 0.0f ? intensity : 0.0f;
        }
        *placed += count_marks(keep, some);
        check_times(rows + field_at[0], step, time_type, some, keep);
        const int64_t own = count_marks(keep, some);
        const int64_t *which = 0;
        if (own < some) {
            int64_t next = 0;
            for (int64_t point = 0; point < some && next < own; point++) {
                chosen[next] = point;
                next += keep[point];
            }
            which = chosen;
        }
        for (int64_t real = 0; real < REALS; real++) {
            float *target = reals + real * room + kept;
            if (which)
                for (int64_t point = 0; point < own; point++)
                    target[point] = values[real][which[point]];
            else
                memcpy(target, values[real], (size_t)own * sizeof *target);
        }
        for (int64_t field = 0; field < fields; field++)
            copy_field(rows + field_at[field], step, field_bytes[field], which, own,
                       out[field] + kept * field_bytes[field]);
        kept += own;
    }
    return kept;
}

/* -- packing ----------------------------------------------------------------------------------- */

enum { DIGIT_BITS = 9, DIGITS = 1 << DIGIT_BITS };

static int64_t bits_of(uint64_t value)
{
    int64_t bits = 0;
    for (; value; value >>= 1)
        bits++;
    return bits;
}

/* Points by stamp, then ring, then their order: their numbers to `order`. ring: NULL: none; words,
   spare (count,): scratch. Return 1 if they are in this order, and `order` was not written; -1 if
   their keys are too long for one word; else 0. */
EXPORT int64_t mlbatch_cloud_order(int64_t count, const int64_t *stamp_ns, const uint16_t *ring,
                             uint64_t *words, uint64_t *spare, int64_t *order)
{
    int64_t low = stamp_ns[0], high = stamp_ns[0];
    uint16_t most = 0;
    int is_sorted = 1, has_rings_sorted = 1;
    for (int64_t point = 0; point < count; point++) {
        const int64_t stamp = stamp_ns[point];
        low = stamp < low ? stamp : low;
        high = stamp > high ? stamp : high;
        if (!point)
            continue;
        is_sorted &= stamp_ns[point - 1] < stamp
            || (stamp_ns[point - 1] == stamp && (!ring || ring[point - 1] <= ring[point]));
    }
    for (int64_t point = 0; ring && point < count; point++) {
        most = ring[point] > most ? ring[point] : most;
        has_rings_sorted &= !point || ring[point - 1] <= ring[point];
    }
    if (is_sorted)
        return 1;
    /* The sort is stable: rings in order need no digits. */
    const int64_t ring_bits = has_rings_sorted ? 0 : bits_of(most);
    const int64_t key_bits = bits_of((uint64_t)high - (uint64_t)low) + ring_bits;
    const int64_t number_bits = bits_of((uint64_t)count);
    if (key_bits + number_bits > 64)
        return -1;
    for (int64_t point = 0; point < count; point++) {
        uint64_t key = (uint64_t)(stamp_ns[point] - low);
        if (ring_bits)
            key = key << ring_bits | ring[point];
        words[point] = key << number_bits | (uint64_t)point;
    }
    for (int64_t shift = number_bits; shift < number_bits + key_bits; shift += DIGIT_BITS) {
        int64_t place[DIGITS] = {0};
        for (int64_t point = 0; point < count; point++)
            place[words[point] >> shift & (DIGITS - 1)]++;
        int64_t before = 0;
        for (int64_t digit = 0; digit < DIGITS; digit++) {
            const int64_t own = place[digit];
            place[digit] = before;
            before += own;
        }
        for (int64_t point = 0; point < count; point++)
            spare[place[words[point] >> shift & (DIGITS - 1)]++] = words[point];
        uint64_t *sorted = spare;
        spare = words;
        words = sorted;
    }
    const uint64_t mask = (UINT64_C(1) << number_bits) - 1;
    for (int64_t point = 0; point < count; point++)
        order[point] = (int64_t)(words[point] & mask);
    return 0;
}

/* Column and slot of each point, in `order` (NULL: their own); by_ring: a slot is a ring, all of
   them below `slots`. Return the number of columns. */
EXPORT int64_t mlbatch_cloud_columns(int64_t count, const int64_t *stamp_ns, const uint16_t *ring,
                               const int64_t *order, int64_t slots, int64_t by_ring,
                               int32_t *column, uint16_t *slot)
{
    /* First column of the stamp, columns that it has, place of the point in its run. */
    int64_t base = 0, layers = 0, rank = 0, before = 0;
    for (int64_t number = 0; number < count; number++) {
        const int64_t point = order ? order[number] : number;
        const int is_new = number == 0 || stamp_ns[point] != stamp_ns[before];
        if (is_new) {
            base += layers;
            layers = 0;
            rank = 0;
        } else if (by_ring && ring[point] != ring[before]) {
            rank = 0;
        }
        const int64_t layer = by_ring ? rank : rank / slots;
        column[number] = (int32_t)(base + layer);
        slot[number] = (uint16_t)(by_ring ? ring[point] : rank % slots);
        layers = layer + 1 > layers ? layer + 1 : layers;
        rank++;
        before = point;
    }
    return base + layers;
}

/* Add the sorted, distinct stamps `added` to the sorted `stamps`; in place, from the end. */
static void insert_stamps(int64_t *stamps, int64_t known, const int64_t *added, int64_t count)
{
    int64_t to = known + count;
    while (count)
        stamps[--to] = known && stamps[known - 1] > added[count - 1] ? stamps[--known]
                                                                      : added[--count];
}

/* The order of the points without a sort: clouds are a few runs in which stamps do not fall, mostly
   one, or one a ring. stamps (count,): the distinct ones; spare (count,): scratch; column (count,):
   number of the stamp of each point; begins (MOST_RUNS + 1,): first point of each run, and the end.
   Return the number of runs, 0 where there are too many, or their stamps differ too much. */
EXPORT int64_t mlbatch_cloud_runs(int64_t count, const int64_t *stamp_ns, int64_t *stamps,
                            int64_t *spare, int32_t *column, int64_t *begins,
                            int64_t *stamp_count)
{
    int64_t runs = 1, longest = 0;
    begins[0] = 0;
    for (int64_t point = 1; point < count; point++)
        if (stamp_ns[point] < stamp_ns[point - 1]) {
            if (runs == MOST_RUNS)
                return 0;
            begins[runs++] = point;
        }
    begins[runs] = count;
    for (int64_t run = 1; run < runs; run++)
        if (begins[run + 1] - begins[run] > begins[longest + 1] - begins[longest])
            longest = run;
    /* The longest run first, since it has most of the stamps of the others. */
    int64_t known = 0;
    for (int64_t point = begins[longest]; point < begins[longest + 1]; point++)
        if (!known || stamps[known - 1] != stamp_ns[point])
            stamps[known++] = stamp_ns[point];
    int64_t work = 0;
    for (int64_t run = 0; run < runs; run++) {
        int64_t at = 0, added = 0;
        for (int64_t point = begins[run]; point < begins[run + 1]; point++) {
            const int64_t stamp = stamp_ns[point];
            while (at < known && stamps[at] < stamp)
                at++;
            if ((at == known || stamps[at] != stamp) && (!added || spare[added - 1] != stamp))
                spare[added++] = stamp;
        }
        if (!added)
            continue;
        work += known + added;
        if (work > 2 * count)
            return 0;
        insert_stamps(stamps, known, spare, added);
        known += added;
    }
    for (int64_t run = 0; run < runs; run++) {
        int64_t at = 0;
        for (int64_t point = begins[run]; point < begins[run + 1]; point++) {
            while (stamps[at] != stamp_ns[point])
                at++;
            column[point] = (int32_t)at;
        }
    }
    *stamp_count = known;
    return runs;
}

/* Stamps (numbers in `column`) to columns, and the slot of each point; ring: NULL: slots in turn.
   used (stamp_count * width,): zeros, width: slots with rings, else 1; layers (stamp_count,):
   zeros. Return the number of columns. */
EXPORT int64_t mlbatch_cloud_slots(int64_t count, const uint16_t *ring, int64_t slots,
                             int64_t stamp_count, int32_t *used, int32_t *layers,
                             int32_t *column, uint16_t *slot)
{
    int is_flat = 1;
    for (int64_t point = 0; point < count; point++) {
        const int64_t stamp = column[point];
        const int32_t before = ring ? used[stamp * slots + ring[point]]++ : used[stamp]++;
        const int32_t layer = ring ? before : (int32_t)(before / slots);
        slot[point] = (uint16_t)(ring ? ring[point] : before % slots);
        layers[stamp] = layer + 1 > layers[stamp] ? layer + 1 : layers[stamp];
        is_flat &= !layer;
    }
    if (is_flat)
        return stamp_count;
    /* From numbers of columns to the first column. */
    int32_t columns = 0;
    for (int64_t stamp = 0; stamp < stamp_count; stamp++) {
        const int32_t own = layers[stamp];
        layers[stamp] = columns;
        columns += own;
    }
    memset(used, 0, (size_t)(stamp_count * (ring ? slots : 1)) * sizeof *used);
    for (int64_t point = 0; point < count; point++) {
        const int64_t stamp = column[point];
        const int32_t before = ring ? used[stamp * slots + ring[point]]++ : used[stamp]++;
        column[point] = layers[stamp] + (ring ? before : (int32_t)(before / slots));
    }
    return columns;
}

/* Write the points to packets of `size` bytes, all zero but their heads: `HEAD` of
   point_packets.py, of which stamps, numbers and counts are written here.

   column, slot (count,): of the points, in `order` (NULL: their own). begins (runs + 1,): runs in
   which columns do not fall. used (columns,): zeros. ring, return_type, tag: NULL: zeros. */
EXPORT void mlbatch_cloud_pack(const int64_t *order, int64_t runs, const int64_t *begins,
                         const int32_t *column, const uint16_t *slot, const int64_t *stamp_ns,
                         int64_t room, const float *reals, const uint16_t *ring,
                         const uint8_t *return_type, const uint8_t *tag, int64_t slots,
                         int64_t size, int64_t columns, uint16_t *used, uint8_t *packets)
{
    enum { STAMP = 8, NUMBER = 16, COUNT = 20, HEAD = 24, COLUMNS_TOGETHER = 64 };
    int64_t next[MOST_RUNS];
    memcpy(next, begins, (size_t)runs * sizeof *next);
    /* Some columns of all runs, whose packets stay in the cache. */
    const int64_t step = runs > 1 ? COLUMNS_TOGETHER : columns;
    for (int64_t end = step; end < columns + step; end += step)
        for (int64_t run = 0; run < runs; run++) {
            int64_t number = next[run];
            for (; number < begins[run + 1] && column[number] < end; number++) {
                const int64_t point = order ? order[number] : number;
                const int64_t at = slot[number];
                uint8_t *packet = packets + column[number] * size;
                uint8_t *plane = packet + HEAD + at * 4;
                for (int64_t real = 0; real < REALS; real++, plane += 4 * slots)
                    memcpy(plane, reals + real * room + point, 4);
                plane = packet + HEAD + 4 * REALS * slots;
                if (ring)
                    memcpy(plane + 2 * at, ring + point, 2);
                plane += 2 * slots;
                if (return_type)
                    plane[at] = return_type[point];
                if (tag)
                    plane[slots + at] = tag[point];
                if (!used[column[number]]++)
                    memcpy(packet + STAMP, stamp_ns + point, 8);
            }
            next[run] = number;
        }
    for (int64_t number = 0; number < columns; number++) {
        const uint32_t own = (uint32_t)number;
        memcpy(packets + number * size + NUMBER, &own, 4);
        memcpy(packets + number * size + COUNT, used + number, 2);
    }
}
