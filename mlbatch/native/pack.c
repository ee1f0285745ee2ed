/* Points to packed records of the output, while they are in the first cache.

   A record is a list of pieces (`Piece`): bytes copied from the arrays of a scan, and values
   computed as in `writers/point_layouts.py`, in float64 and rounded once. Bytes between the
   pieces are not written. */
#include <string.h>

#include "native.h"

#define NS_PER_S 1000000000

/* The time of a label, ns after the start of the scan. */
static inline uint32_t time_of(int64_t label)
{
    return (uint32_t)(uint64_t)label;
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

/* One computed piece of all points. */
static void compute(const Scan *scan, const Rows *rows, int64_t kind, int64_t count, uint8_t *to)
{
    const int64_t step = scan->record_bytes;
    /* As Python's divmod, which rounds down. */
    int64_t whole_s = scan->start_ns / NS_PER_S, rest_ns = scan->start_ns % NS_PER_S;
    if (rest_ns < 0) {
        whole_s--;
        rest_ns += NS_PER_S;
    }
    for (int64_t row = 0; row < count; row++, to += step) {
        const int64_t from = row * rows->step;
        const uint32_t time_ns = time_of(rows->label[from]);
        if (kind == SECONDS_F4) {
            const float value = seconds_toward_zero(time_ns);
            memcpy(to, &value, sizeof value);
        } else if (kind == SECONDS_F8) {
            const double value = seconds(time_ns);
            memcpy(to, &value, sizeof value);
        } else if (kind == STAMP_F8) {
            const double rest_s = (double)(time_ns + rest_ns) / (double)NS_PER_S;
            const double value = rest_s + (double)whole_s;
            memcpy(to, &value, sizeof value);
        } else if (kind == RING_I4) {
            const int32_t value = (int32_t)((uint64_t)rows->label[from] >> 32 & 0xFFFF);
            memcpy(to, &value, sizeof value);
        } else {
            const uint32_t value = millimetres(rows->range_m[from]);
            memcpy(to, &value, sizeof value);
        }
    }
}

void mlbatch_pack(const Scan *scan, const Rows *rows, int64_t count, uint8_t *record)
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
            compute(scan, rows, piece->kind, count, record + piece->offset);
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
