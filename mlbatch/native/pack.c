/* Points to packed records of the output, while they are in the first cache.

   A record is a list of pieces (`Piece`): bytes copied from the arrays of a scan, and values
   computed of them in float64 and rounded once. Bytes between the pieces are not written. */
#include <string.h>

#include "native.h"

/* The time of a label, ns after the start of the scan. */
static inline uint32_t time_of(int64_t label)
{
    return (uint32_t)(uint64_t)label;
}

static inline int32_t ring_of(int64_t label)
{
    return (int32_t)((uint64_t)label >> 32 & 0xFFFF);
}

static inline int32_t lidar_of(int64_t label)
{
    return (int32_t)((uint64_t)label >> 56);
}

static inline double seconds(uint32_t time_ns)
{
    return (double)time_ns / (double)NS_PER_S;
}

/* Seconds in float32, rounded toward zero: the bits that float32 lacks are cleared. */
static inline float seconds_toward_zero(uint32_t time_ns)
{
    double value = seconds(time_ns);
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    bits &= ~((UINT64_C(1) << 29) - 1);
    memcpy(&value, &bits, sizeof bits);
    return (float)value;
}

/* Whole millimetres, ties to even; 0 for NaN. The sum with 2**52 has no bits for fractions. */
static inline uint32_t millimetres(float range_m)
{
    if (!(range_m >= 0))
        return 0;
    const double whole = (double)range_m * 1000.0 + 0x1p52;
    return (uint32_t)(whole - 0x1p52);
}

/* With constant sizes the compiler needs no call. */
static void copy(const uint8_t *from, int64_t from_step, int64_t bytes, int64_t count,
                 int64_t step, uint8_t *to)
{
#define COPY_ROWS(size)                                                                            \
    for (int64_t row = 0; row < count; row++)                                                      \
        memcpy(to + row * step, from + row * from_step, size)
    switch (bytes) {
    case 2: COPY_ROWS(2); break;
    case 4: COPY_ROWS(4); break;
    case 12: COPY_ROWS(12); break;
    case 16: COPY_ROWS(16); break;
    default: COPY_ROWS((size_t)bytes);
    }
#undef COPY_ROWS
}

/* Points and labels as one record, 16 + 8 bytes: only the time differs. */
static void pack_standard(const Rows *rows, int64_t count, uint8_t *record)
{
    uint32_t last_ns = 0;
    float last_s = 0.0f;
    for (int64_t row = 0; row < count; row++, record += 24) {
        const int64_t from = row * rows->step;
        const int64_t label = rows->label[from];
        const uint32_t time_ns = time_of(label);
        /* Points of a column often have one time. */
        if (time_ns != last_ns) {
            last_ns = time_ns;
            last_s = seconds_toward_zero(time_ns);
        }
        uint32_t time_bits;
        memcpy(&time_bits, &last_s, sizeof time_bits);
        const uint64_t rest = (uint64_t)label >> 32 << 32 | time_bits;
        memcpy(record, rows->point + 4 * from, 16);
        memcpy(record + 16, &rest, sizeof rest);
    }
}

static int is_standard(const Scan *scan)
{
    const Piece *piece = scan->pieces;
    return scan->record_bytes == 24 && scan->piece_count == 3
        && piece[0].kind == COPY_POINT && piece[0].offset == 0 && piece[0].bytes == 16
        && piece[1].kind == SECONDS_F4 && piece[1].offset == 16
        && piece[2].kind == COPY_LABEL && piece[2].offset == 20 && piece[2].bytes == 4;
}

/* -- LAS ---------------------------------------------------------------------------------------- */

/* Vectors as GCC and Clang have them, for every processor. */
typedef float Four __attribute__((vector_size(16)));
typedef int32_t FourWords __attribute__((vector_size(16)));
typedef float Pair __attribute__((vector_size(8)));
typedef double Doubles __attribute__((vector_size(16)));
#if defined(__clang__)
#define EVEN_WORDS(first, second) __builtin_shufflevector(first, second, 0, 2, 4, 6)
#else
#define EVEN_WORDS(first, second) __builtin_shuffle(first, second, (FourWords){0, 2, 4, 6})
#endif

/* Coordinates and one more value in multiples of 0.1 mm, ties to even: the sum has no bits for
   fractions, and its low half is the number. The product is exact, since a float32 has 24 bits
   and 10000 has 14. */
static inline FourWords steps(const float *point)
{
    const Doubles per_m = {1e4, 1e4}, whole = {0x1.8p52, 0x1.8p52};
    Pair first, second;
    memcpy(&first, point, sizeof first);
    memcpy(&second, point + 2, sizeof second);
    const Doubles xy = __builtin_convertvector(first, Doubles) * per_m + whole;
    const Doubles z = __builtin_convertvector(second, Doubles) * per_m + whole;
    return EVEN_WORDS((FourWords)xy, (FourWords)z);
}

/* The nearest number of 16 bits, ties to even: as above, in float32. */
static inline uint32_t level(float intensity)
{
    const float most = 65535.0f, positive = intensity > 0.0f ? intensity : 0.0f;
    const float whole = (positive < most ? positive : most) + 0x1p23f;
    uint32_t bits;
    memcpy(&bits, &whole, sizeof bits);
    return bits & 0xFFFF;
}

/* By return type: number of a return, and in the upper half that of all returns. Of two returns the
   first is the nearer one. */
static const uint8_t RETURNS[8] = {0x11, 0x11, 0x11, 0x21, 0x22, 0x21, 0x22, 0x11};
enum { SECOND = 0x22 };

static inline Four chosen(FourWords is_first, Four first, Four second)
{
    return (Four)((is_first & (FourWords)first) | (~is_first & (FourWords)second));
}

/* Point data record format 6 and extra bytes, as in `las_encoder.py`; the points are side by side.
   bytes: of the record, the last two a reflectivity or not there. */
static void pack_las(const Rows *rows, int64_t count, int64_t bytes, double whole_s,
                     int64_t rest_ns, Totals *totals, uint8_t *restrict record)
{
    enum { LEVEL_AT = 12, ZERO_AT = 16, STAMP_AT = 22, LABEL_AT = 30, REAL_AT = 37, LAST_AT = 41 };
    const uint64_t ring_bits = UINT64_C(0xFFFF) << 32;
    const float *restrict point = rows->point;
    const int64_t *restrict labels = rows->label;
    const uint16_t *restrict reflectivity = bytes > LAST_AT ? rows->reflectivity : 0;
    Four low, high;
    memcpy(&low, totals->low, sizeof low);
    memcpy(&high, totals->high, sizeof high);
    int64_t second = 0;
    uint64_t last = 0;
    uint32_t number = 0;
    double stamp_s = 0;
    for (int64_t row = 0; row < count; row++, point += 4, record += bytes) {
        const uint64_t label = (uint64_t)labels[row];
        /* Points of a column mostly differ in the ring alone. */
        if (!row || (label & ~ring_bits) != last) {
            last = label & ~ring_bits;
            stamp_s = (double)(time_of(labels[row]) + rest_ns) / (double)NS_PER_S + whole_s;
            const uint64_t type = label >> 48 & 0xFF;
            number = RETURNS[type < 8 ? type : 0];
        }
        Four values;
        memcpy(&values, point, sizeof values);
        low = chosen(values < low, values, low);
        high = chosen(values > high, values, high);
        second += number == SECOND;
        const FourWords xyz = steps(point);
        const uint32_t levels = level(point[3]) | number << 16;
        /* Flags, classification, user data and scan angle are 0; 0 is no source. */
        const uint64_t source = ((label >> 56) + 1) << 32;
        memcpy(record, &xyz, sizeof xyz);
        memcpy(record + LEVEL_AT, &levels, sizeof levels);
        memcpy(record + ZERO_AT, &source, 6);
        memcpy(record + STAMP_AT, &stamp_s, sizeof stamp_s);
        /* Time, ring, return type; the sensor is overwritten. */
        memcpy(record + LABEL_AT, &label, sizeof label);
        memcpy(record + REAL_AT, point + 3, sizeof *point);
        if (reflectivity)
            memcpy(record + LAST_AT, reflectivity + row, sizeof *reflectivity);
    }
    memcpy(totals->low, &low, sizeof low);
    memcpy(totals->high, &high, sizeof high);
    totals->second += second;
}

/* -- pieces ------------------------------------------------------------------------------------- */

/* One computed piece of all points. */
static void compute(const Scan *scan, const Rows *rows, const Piece *piece, int64_t count, uint8_t *to)
{
#define EACH(type, expression)                                                                     \
    for (int64_t row = 0; row < count; row++, to += scan->record_bytes) {                          \
        const int64_t from = row * rows->step;                                                     \
        const type value = (expression);                                                           \
        memcpy(to, &value, sizeof value);                                                          \
    }                                                                                              \
    break
    /* As Python's divmod, which rounds down. */
    int64_t whole = scan->stamp_start_ns / NS_PER_S, rest_ns = scan->stamp_start_ns % NS_PER_S;
    if (rest_ns < 0) {
        whole--;
        rest_ns += NS_PER_S;
    }
    const double whole_s = (double)whole;
    const int64_t *label = rows->label;
    switch (piece->kind) {
    case SECONDS_F4: EACH(float, seconds_toward_zero(time_of(label[from])));
    case SECONDS_F8: EACH(double, seconds(time_of(label[from])));
    case STAMP_F8:
        EACH(double, (double)(time_of(label[from]) + rest_ns) / (double)NS_PER_S + whole_s);
    case RING_I4: EACH(int32_t, ring_of(label[from]));
    case RING_F4: EACH(float, (float)ring_of(label[from]));
    case LIDAR_F4: EACH(float, (float)lidar_of(label[from]));
    case LAS: pack_las(rows, count, piece->bytes, whole_s, rest_ns, scan->totals, to); break;
    default: EACH(uint32_t, millimetres(rows->range_m[from]));
    }
#undef EACH
}

EXPORT void mlbatch_pack(const Scan *scan, const Rows *rows, int64_t count, uint8_t *record)
{
    if (is_standard(scan)) {
        pack_standard(rows, count, record);
        return;
    }
    for (int64_t number = 0; number < scan->piece_count; number++) {
        const Piece *piece = scan->pieces + number;
        const uint8_t *from = 0;
        int64_t width = 0;
        if (piece->kind == COPY_POINT) {
            from = (const uint8_t *)rows->point;
            width = 16;
        } else if (piece->kind == COPY_LABEL) {
            from = (const uint8_t *)rows->label;
            width = 8;
        } else if (piece->kind == COPY_REFLECTIVITY) {
            from = (const uint8_t *)rows->reflectivity;
            width = 2;
        }
        if (from)
            copy(from + piece->source, width * rows->step, piece->bytes, count,
                 scan->record_bytes, record + piece->offset);
        else
            compute(scan, rows, piece, count, record + piece->offset);
    }
}

/* Labels with the time in s as float32 bits instead of ns. */
static void to_seconds(int64_t *labels, int64_t count)
{
    uint32_t last_ns = 0, last_bits = 0;
    for (int64_t slot = 0; slot < count; slot++) {
        const uint32_t time_ns = time_of(labels[slot]);
        /* Empty slots have time 0; without a branch, since they are anywhere. */
        if ((time_ns != last_ns) & (time_ns != 0)) {
            const float value = seconds_toward_zero(time_ns);
            last_ns = time_ns;
            memcpy(&last_bits, &value, sizeof value);
        }
        const uint32_t bits = last_bits & -(uint32_t)(time_ns != 0);
        labels[slot] = (int64_t)((uint64_t)labels[slot] >> 32 << 32 | bits);
    }
}

/* Slot by slot, so that the columns of a slot are written together. */
void mlbatch_pack_rows(const Scan *scan, int64_t begin, int64_t end)
{
    const int64_t slots = scan->row_slots, step = mlbatch_row_step(scan), count = end - begin;
    const int has_seconds = is_standard(scan);
    for (int64_t row = 0; has_seconds && row < count; row++)
        to_seconds(scan->label + row * step, slots);
    for (int64_t slot = 0; slot < slots; slot++) {
        uint8_t *record = scan->records + (slot * scan->columns + begin) * scan->record_bytes;
        const Rows rows = {scan->point + 4 * slot, scan->label + slot,
                           scan->range_m ? scan->range_m + slot : 0,
                           scan->reflectivity ? scan->reflectivity + slot : 0, step};
        if (!has_seconds) {
            mlbatch_pack(scan, &rows, count, record);
            continue;
        }
        for (int64_t row = 0; row < count; row++, record += 24) {
            memcpy(record, rows.point + 4 * row * step, 16);
            memcpy(record + 16, rows.label + row * step, 8);
        }
    }
}
