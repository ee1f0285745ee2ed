/* Points of decoded clouds: from the rows of a message to packets of columns.

   Called by `ros/point_rows.py` and `ros/point_packets.py`. */
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

#define AS_REAL(type) \
    { \
        type value; \
        memcpy(&value, from, sizeof value); \
        return (float)value; \
    }

/* A number of any type as float32; 0 of none. */
static inline float real_of(const uint8_t *from, int64_t type)
{
    switch (type) {
    case INT8: AS_REAL(int8_t)
    case UINT8: AS_REAL(uint8_t)
    case INT16: AS_REAL(int16_t)
    case UINT16: AS_REAL(uint16_t)
    case INT32: AS_REAL(int32_t)
    case UINT32: AS_REAL(uint32_t)
    case FLOAT32: AS_REAL(float)
    case FLOAT64: AS_REAL(double)
    default: return 0;
    }
}

/* Numbers of one type that are `step` bytes apart. */
static void read_reals(const uint8_t *from, int64_t step, int64_t type, int64_t count, float *out)
{
    /* With a constant type the compiler leaves out the branches. */
    if (type == FLOAT32)
        for (int64_t point = 0; point < count; point++)
            out[point] = real_of(from + point * step, FLOAT32);
    else
        for (int64_t point = 0; point < count; point++)
            out[point] = real_of(from + point * step, type);
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

/* Write the points to packets of `size` bytes, all zero but their heads (`HEAD` of
   point_packets.py). Stamps, numbers and counts in the heads are written here.

   column, slot (count,): of the points, in `order` (NULL: their own). used (columns,): zeros.
   ring, return_type, tag: NULL: zeros. */
EXPORT void mlbatch_cloud_pack(int64_t count, const int64_t *order, const int32_t *column,
                         const uint16_t *slot, const int64_t *stamp_ns, int64_t room,
                         const float *reals, const uint16_t *ring, const uint8_t *return_type,
                         const uint8_t *tag, int64_t slots, int64_t size, int64_t columns,
                         uint16_t *used, uint8_t *packets)
{
    enum { STAMP = 8, NUMBER = 16, COUNT = 20, HEAD = 24 };
    for (int64_t number = 0; number < count; number++) {
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
    for (int64_t number = 0; number < columns; number++) {
        const uint32_t own = (uint32_t)number;
        memcpy(packets + number * size + NUMBER, &own, 4);
        memcpy(packets + number * size + COUNT, used + number, 2);
    }
}

/* -- rows straight to packets ------------------------------------------------------------------ */

/* Clouds of a spinning lidar with a ring for each point, from the rows of a message to packets
   without planes in between; what is unusual is left to the functions above. */

/* Bytes of rows that are fetched ahead, over the ends of pages. */
enum { FETCHED = 2048 };
/* Times are inserted at most so often a point, counted in times that are moved. */
enum { MOST_MOVED = 4 };

/* What `mlbatch_cloud_times` finds. times (room,): distinct, in order, of one type; by_order
   (room,): their numbers, in order of appearance; is_used (room,): by number, whether a point has
   it; number (points,), begins (MOST_RUNS + 1,): as there. */
typedef struct {
    int64_t count, step, room, known, moved, placed, found, runs;
    const uint8_t *rows;
    const int64_t *axes_at;
    int64_t time_at;
    void *times;
    int32_t *by_order, *number;
    uint8_t *is_used;
    int64_t *begins;
} Times;

/* Give the next number to a time at `at`. Return 0 where there is no room, or too much is moved. */
static int insert_number(Times *all, int64_t at)
{
    const size_t after = (size_t)(all->known - at);
    all->moved += (int64_t)after;
    if (all->known == all->room || all->moved > MOST_MOVED * all->count + all->room)
        return 0;
    memmove(all->by_order + at + 1, all->by_order + at, after * sizeof *all->by_order);
    all->by_order[at] = (int32_t)all->known;
    all->is_used[all->known++] = 0;
    return 1;
}

/* Number the times of all points: most are the last one, or the one after it, also of shots without
   a place; these say which times there are, too: most are known after the first run. Return 0 for an
   unusual cloud. */
#define FOLLOW(name, type, IS_FINITE) \
    static int name(Times *all) \
    { \
        type *times = all->times; \
        type last = 0, after = 0; \
        int64_t at = -1; \
        int32_t own = -1; \
        int has_after = 0; \
        const uint8_t *row = all->rows; \
        const int64_t count = all->count, step = all->step, time_at = all->time_at; \
        const int64_t x_at = all->axes_at[0], y_at = all->axes_at[1], z_at = all->axes_at[2]; \
        int32_t *restrict number = all->number; \
        int64_t placed = 0, found = 0; \
        for (int64_t point = 0; point < count; point++, row += step) { \
            __builtin_prefetch(row + FETCHED); \
            const float x = real_of(row + x_at, FLOAT32); \
            const float y = real_of(row + y_at, FLOAT32); \
            const float z = real_of(row + z_at, FLOAT32); \
            const float squared = x * x + y * y + z * z; \
            type time; \
            memcpy(&time, row + time_at, sizeof time); \
            const int is_placed = (squared > 0.0f) & (squared < INFINITY); \
            placed += is_placed; \
            const int is_same = own >= 0 && time == last; \
            if (is_same || (has_after && time == after)) { \
                /* No branch on places: shots without a return are scattered. */ \
                if (!is_same) { \
                    at++; \
                    last = time; \
                    own = all->by_order[at]; \
                    has_after = at + 1 < all->known; \
                    if (has_after) \
                        after = times[at + 1]; \
                } \
                found += is_placed; \
                all->is_used[own] |= (uint8_t)is_placed; \
                number[point] = own | (is_placed - 1); \
                continue; \
            } \
            if (!is_placed || !(IS_FINITE)) { \
                number[point] = -1; \
                if ((IS_FINITE) && all->known < all->room \
                    && (!all->known || time > times[all->known - 1])) { \
                    times[all->known] = time; \
                    if (!insert_number(all, all->known)) \
                        return 0; \
                    has_after = 0; \
                } \
                continue; \
            } \
            found++; \
            int64_t low = own >= 0 && time > last ? at + 1 : 0, high = all->known; \
            if (own < 0 || time < last) { \
                if (all->runs == MOST_RUNS) \
                    return 0; \
                all->begins[all->runs++] = point; \
            } \
            while (low < high) { \
                const int64_t middle = (low + high) / 2; \
                if (times[middle] < time) \
                    low = middle + 1; \
                else \
                    high = middle; \
            } \
            at = low; \
            if (at == all->known || times[at] != time) { \
                const size_t later = (size_t)(all->known - at); \
                if (!insert_number(all, at)) \
                    return 0; \
                memmove(times + at + 1, times + at, later * sizeof *times); \
                times[at] = time; \
            } \
            last = time; \
            own = all->by_order[at]; \
            all->is_used[own] = 1; \
            number[point] = own; \
            has_after = at + 1 < all->known; \
            if (has_after) \
                after = times[at + 1]; \
        } \
        all->placed = placed; \
        all->found = found; \
        return 1; \
    }

FOLLOW(follow_u4, uint32_t, 1)
FOLLOW(follow_i4, int32_t, 1)
FOLLOW(follow_f4, float, time - time == 0)
FOLLOW(follow_f8, double, time - time == 0)

/* Find the points that have a place and a finite time, and their times. Places are float32.

   rows: of `step` bytes; axes_at (3,); times (room,): of the type `time_type`: the distinct ones
   in order; number (count,): of the time of each point in order of appearance, -1: no point;
   by_order, is_used (room,): scratch; rank (room + 1,): of each number in order, behind that of
   -1; begins (MOST_RUNS + 1,): runs in which times do not fall; figures (3,): points with a place,
   points found, runs. Return how many times there are, or -1 for an unusual cloud. */
EXPORT int64_t mlbatch_cloud_times(int64_t count, const uint8_t *rows, int64_t step,
                             const int64_t *axes_at, int64_t time_at, int64_t time_type,
                             int64_t room, uint8_t *times, int32_t *number, int32_t *by_order,
                             uint8_t *is_used, int32_t *rank, int64_t *begins, int64_t *figures)
{
    Times all = {.count = count, .step = step, .room = room, .rows = rows, .axes_at = axes_at,
                 .time_at = time_at, .times = times, .by_order = by_order, .number = number,
                 .is_used = is_used, .begins = begins};
    int is_usual = 0;
    switch (time_type) {
    case UINT32: is_usual = follow_u4(&all); break;
    case INT32: is_usual = follow_i4(&all); break;
    case FLOAT32: is_usual = follow_f4(&all); break;
    case FLOAT64: is_usual = follow_f8(&all); break;
    default: break;
    }
    if (!is_usual)
        return -1;
    begins[all.runs] = count;
    /* Only times of points. */
    const int64_t bytes = time_type == FLOAT64 ? 8 : 4;
    int64_t used = 0;
    rank[0] = -1;
    for (int64_t at = 0; at < all.known; at++) {
        const int32_t own = by_order[at];
        rank[own + 1] = is_used[own] ? (int32_t)used : -1;
        if (!is_used[own])
            continue;
        memmove(times + used * bytes, times + at * bytes, (size_t)bytes);
        used++;
    }
    figures[0] = all.placed;
    figures[1] = all.found;
    figures[2] = all.runs;
    return used;
}

/* How `mlbatch_cloud_fill` reads rows and writes packets. */
typedef struct {
    const uint8_t *rows;
    int64_t step;
    const int64_t *at, *types; /* of its fields */
    const int32_t *number, *rank;
    int64_t slots, size;
    uint8_t *packets;
} Fill;

enum { X_AT, Y_AT, Z_AT, INTENSITY_AT, RING_AT, TYPE_AT, TAG_AT };
enum { PACKET_HEAD = 24 };

/* Write the points from `*next` on to the columns below `end`; columns do not fall up to `stop`.
   Return how many, -1 where a ring is not below `slots`. */
static inline int64_t fill_run(const Fill *fill, int64_t *next, int64_t stop, int64_t end,
                               int64_t intensity_type, int64_t ring_type, int has_more)
{
    const int64_t *at = fill->at;
    const int64_t x_at = at[X_AT], y_at = at[Y_AT], z_at = at[Z_AT];
    const int64_t intensity_byte = at[INTENSITY_AT], ring_at = at[RING_AT];
    const int64_t slots = fill->slots, plane = 4 * slots, size = fill->size, step = fill->step;
    const int32_t *rank = fill->rank + 1, *number = fill->number;
    uint8_t *packets = fill->packets + PACKET_HEAD;
    int64_t written = 0, point = *next;
    const uint8_t *row = fill->rows + point * step;
    for (; point < stop; point++, row += step) {
        const int64_t column = rank[number[point]];
        if (column >= end)
            break;
        if (column < 0)
            continue;
        uint16_t ring = row[ring_at];
        if (ring_type == UINT16)
            memcpy(&ring, row + ring_at, sizeof ring);
        if (ring >= slots)
            return -1;
        uint8_t *packet = packets + column * size;
        uint8_t *slot = packet + 4 * (int64_t)ring;
        uint32_t axes[AXES];
        memcpy(axes, row + x_at, 4);
        memcpy(axes + 1, row + y_at, 4);
        memcpy(axes + 2, row + z_at, 4);
        /* An intensity that is no finite number is 0. */
        const float stored = real_of(row + intensity_byte, intensity_type);
        const float intensity = stored - stored == 0.0f ? stored : 0.0f;
        memcpy(slot, axes, 4);
        memcpy(slot + plane, axes + 1, 4);
        memcpy(slot + 2 * plane, axes + 2, 4);
        memcpy(slot + 3 * plane, &intensity, 4);
        packet += 4 * plane;
        memcpy(packet + 2 * (int64_t)ring, &ring, sizeof ring);
        if (has_more) {
            packet += 2 * slots + ring;
            if (fill->types[TYPE_AT])
                packet[0] = row[at[TYPE_AT]];
            if (fill->types[TAG_AT])
                packet[slots] = row[at[TAG_AT]];
        }
        written++;
    }
    *next = point;
    return written;
}

/* Slots of a packet that have a point: a place is not zero. */
static int64_t count_slots(const uint8_t *packet, int64_t slots)
{
    const uint8_t *x = packet + PACKET_HEAD, *y = x + 4 * slots, *z = y + 4 * slots;
    int32_t found = 0;
    for (int64_t slot = 0; slot < slots; slot++) {
        uint32_t bits[AXES];
        memcpy(bits, x + 4 * slot, 4);
        memcpy(bits + 1, y + 4 * slot, 4);
        memcpy(bits + 2, z + 4 * slot, 4);
        /* All but their signs. */
        found += (bits[0] | bits[1] | bits[2]) << 1 != 0;
    }
    return found;
}

/* Write the points that `mlbatch_cloud_times` found to packets by ring, each of `size` bytes.

   fields_at (7,): bytes of x, y, z, intensity, ring, return type and tag in a row; types (7,): of
   them, 0: none; the ring, which must be there, is UINT8 or UINT16, return type and tag are UINT8.
   head (24,): of all packets; stamp_ns (columns,); keys (columns,): by `mlbatch_content_key` with
   `odd`, not written if that is NULL. Return 1; 0 where a ring is not below `slots`,
   or a column has two points of a ring: the packets are then not complete. */
EXPORT int64_t mlbatch_cloud_fill(const uint8_t *rows, int64_t step, const int64_t *fields_at,
                            const int64_t *types, int64_t runs, const int64_t *begins,
                            const int32_t *number, const int32_t *rank, int64_t columns,
                            const int64_t *stamp_ns, const uint8_t *head, int64_t slots,
                            int64_t size, const uint64_t *odd, uint8_t *packets,
                            int64_t *keys)
{
    /* NEAR: columns whose packets stay in the cache. */
    enum { STAMP = 8, NUMBER = 16, COUNT = 20, NEAR = 64 };
    const Fill fill = {rows, step, fields_at, types, number, rank, slots, size, packets};
    const int has_more = types[TYPE_AT] || types[TAG_AT];
    const int is_plain = types[INTENSITY_AT] == FLOAT32 && !has_more;
    int64_t next[MOST_RUNS];
    memcpy(next, begins, (size_t)runs * sizeof *next);
    for (int64_t first = 0; first < columns; first += NEAR) {
        const int64_t end = first + NEAR < columns ? first + NEAR : columns;
        memset(packets + first * size, 0, (size_t)((end - first) * size));
        int64_t left = 0;
        for (int64_t run = 0; run < runs; run++) {
            const int64_t stop = begins[run + 1];
            int64_t written;
            /* With constant types the compiler leaves out the branches. */
            if (is_plain && types[RING_AT] == UINT16)
                written = fill_run(&fill, next + run, stop, end, FLOAT32, UINT16, 0);
            else if (is_plain)
                written = fill_run(&fill, next + run, stop, end, FLOAT32, UINT8, 0);
            else
                written = fill_run(&fill, next + run, stop, end, types[INTENSITY_AT],
                                   types[RING_AT], has_more);
            if (written < 0)
                return 0;
            left += written;
        }
        for (int64_t column = first; column < end; column++) {
            uint8_t *packet = packets + column * size;
            const uint32_t own = (uint32_t)column;
            const uint16_t points = (uint16_t)count_slots(packet, slots);
            left -= points;
            memcpy(packet, head, PACKET_HEAD);
            memcpy(packet + STAMP, stamp_ns + column, 8);
            memcpy(packet + NUMBER, &own, sizeof own);
            memcpy(packet + COUNT, &points, sizeof points);
            if (odd)
                keys[column] = mlbatch_content_key(packet, size, odd);
        }
        /* Two points of a ring are in one slot. */
        if (left)
            return 0;
    }
    return 1;
}
