/* Columns of a window to points of a scan: every pixel is read once and written to its final row.

   Formulas: `lidar/geometry.py`, `lidar/projections.py`. A column is decoded to planes, one value a
   beam, which fit into the first cache; an element is `return * width + beam`. Beams beyond those
   of the lidar have no return.

   Loops are written once, for vectors of LANES numbers (`decode_wide.c` has more), or without
   branches, so that compilers make vectors of them. With any number of lanes the operations on a
   value are the same, and so are the bytes on all processors. */
#include <math.h>
#include <string.h>

#include "native.h"

#if defined(MLBATCH_WIDE)
#include <cpuid.h>
#endif

#define MOST_ELEMENTS (MOST_BEAMS * MOST_RETURNS)
#define TYPE_BIT 48
#define LIDAR_ID_BIT 56
/* Rotor words: `lidar/geometry.py`. */
#define SPEED_BIT 32
#define SPEED_SIGN (INT64_C(1) << 23)
#define TABLE_BIT 56
/* `Group.used` where the axis of the rotor is vertical: vector 3 is zero for x and y, vectors 1 and
   2 are for z. As a constant it saves a tenth of the time of a scan. */
#define UPRIGHT_VECTORS 043

/* x, y, z, level */
enum { AXES = 3, POINT = 4 };

#ifndef LANES
#define LANES 4
#endif

/* Numbers of LANES beams. */
typedef float Floats __attribute__((vector_size(4 * LANES)));
typedef int32_t Ints __attribute__((vector_size(4 * LANES)));
typedef uint32_t Words __attribute__((vector_size(4 * LANES)));

/* Planes of one column. */
typedef struct {
    _Alignas(64) float range_m[MOST_ELEMENTS];
    _Alignas(64) float xyz[AXES][MOST_ELEMENTS];
    _Alignas(64) float level[MOST_ELEMENTS];
    _Alignas(64) int32_t keep[MOST_ELEMENTS]; /* bits of ones, or 0 */
    _Alignas(64) uint32_t words[MOST_WORDS][MOST_BEAMS];
    const uint8_t *words_at[MOST_WORDS]; /* in `words`, or in the record */
    _Alignas(64) uint16_t reflectivity[MOST_ELEMENTS];
    _Alignas(64) int64_t label[MOST_ELEMENTS];
    _Alignas(64) float point[MOST_ELEMENTS][POINT];
} Planes;

/* Elements of two vectors by their numbers. */
#if defined(__clang__)
#define SHUFFLE(kind, a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define SHUFFLE(kind, a, b, ...) __builtin_shuffle(a, b, (kind){__VA_ARGS__})
#endif

/* -- pixels ------------------------------------------------------------------------------------ */

/* Words of pixels that are `step` bytes apart. Words of short pixels reach up to 3 bytes beyond
   them; rings have that much room behind their last column. */
FOR_CONSTANTS void gather_every(const uint8_t *from, int64_t step, int64_t count, uint32_t *out)
{
    int64_t pixel = 0;
#if LANES == 8
    /* Four by a shuffle of bytes, from five pixels, or from four pixels and the next byte. */
    typedef uint8_t Bytes __attribute__((vector_size(16)));
    for (; step == 3 && count >= 8 && pixel + 4 <= count; pixel += 4) {
        Bytes bytes;
        const int is_last = pixel + 8 > count;
        memcpy(&bytes, from + 3 * pixel - (is_last ? 3 : 0), sizeof bytes);
        bytes = is_last
            ? SHUFFLE(Bytes, bytes, bytes, 3, 4, 5, 6, 6, 7, 8, 9, 9, 10, 11, 12, 12, 13, 14, 15)
            : SHUFFLE(Bytes, bytes, bytes, 0, 1, 2, 3, 3, 4, 5, 6, 6, 7, 8, 9, 9, 10, 11, 12);
        memcpy(out + pixel, &bytes, sizeof bytes);
    }
#endif
    for (; pixel < count; pixel++)
        memcpy(out + pixel, from + pixel * step, 4);
}

static void gather(const uint8_t *from, int64_t step, int64_t count, uint32_t *out)
{
    /* With constant steps the compiler vectorises. */
    switch (step) {
    case 3: gather_every(from, 3, count, out); break;
    case 4: gather_every(from, 4, count, out); break;
    case 8: gather_every(from, 8, count, out); break;
    case 12: gather_every(from, 12, count, out); break;
    case 16: gather_every(from, 16, count, out); break;
    default: gather_every(from, step, count, out);
    }
}

static inline Floats load(const float *from)
{
    Floats values;
    memcpy(&values, from, sizeof values);
    return values;
}

static inline void store(float *to, Floats values)
{
    memcpy(to, &values, sizeof values);
}

static inline Ints load_keep(const int32_t *from)
{
    Ints lanes;
    memcpy(&lanes, from, sizeof lanes);
    return lanes;
}

/* Bits of the lanes that are kept. */
static inline int bits_of(Ints keep)
{
#if LANES == 8
    return __builtin_ia32_movmskps256((Floats)keep);
#elif defined(__SSE__)
    return __builtin_ia32_movmskps((Floats)keep);
#else
    const Ints bits = keep & (Ints){1, 2, 4, 8};
    return bits[0] | bits[1] | bits[2] | bits[3];
#endif
}

static inline Words field_of(const Field *field, Words words)
{
    return words >> (uint32_t)field->shift & (uint32_t)field->mask;
}

/* Words of the pixels of one return, of all channels; distances of 0 for channels without returns
   and beyond the channels. Pixels that are words, all of them in a row, stay where they are. */
static void read_words(const Group *group, const uint8_t *record, int64_t which, Planes *planes)
{
    const int64_t *run = group->runs + which * group->run_count * 3;
    const int64_t *bytes = group->word_bytes + which * group->word_count;
    if (group->step == 4 && group->word_count == 1 && run[2] == group->width
        && !group->dark_count) {
        planes->words_at[0] = record + run[0] + bytes[0];
        return;
    }
    for (int64_t word = 0; word < group->word_count; word++)
        planes->words_at[word] = (const uint8_t *)planes->words[word];
    for (int64_t number = 0; number < group->run_count; number++, run += 3)
        for (int64_t word = 0; word < group->word_count; word++)
            gather(record + run[0] + bytes[word], group->step, run[2],
                   planes->words[word] + run[1]);
    const Field *distance = group->fields + which * FIELDS + DISTANCE;
    const uint32_t bits = distance->is_big ? 0xFFFF : (uint32_t)distance->mask;
    uint32_t *words = planes->words[distance->word];
    for (int64_t number = 0; number < group->dark_count; number++)
        words[group->dark[number]] &= ~(bits << (int)distance->shift);
    for (int64_t beam = group->beams; beam < group->width; beam++)
        words[beam] = 0;
}

static void read_reflectivities(const uint8_t *restrict words, const Field *field, int64_t width,
                                uint16_t *restrict reflectivity)
{
    const int shift = (int)field->shift;
    const uint32_t mask = (uint32_t)field->mask;
    for (int64_t beam = 0; beam < width; beam++) {
        uint32_t word;
        memcpy(&word, words + beam * (int64_t)sizeof word, sizeof word);
        reflectivity[beam] = (uint16_t)(word >> shift & mask);
    }
}

/* Range, level and reflectivity of all returns of a column, and which have a range. */
static void read_pixels(const Group *group, const uint8_t *record, Planes *planes)
{
    const int64_t width = group->width;
    const int32_t silent = (int32_t)group->silent;
    const float factor = group->scale[0], divisor = group->scale[1];
    for (int64_t which = 0; which < group->returns; which++) {
        const Field *fields = group->fields + which * FIELDS;
        const Field distance = fields[DISTANCE], level = fields[INTENSITY];
        read_words(group, record, which, planes);
        const uint8_t *distances = planes->words_at[distance.word];
        const uint8_t *levels = planes->words_at[level.word];
        for (int64_t beam = 0, element = which * width; beam < width;
             beam += LANES, element += LANES) {
            Words words;
            memcpy(&words, distances + beam * (int64_t)sizeof(uint32_t), sizeof words);
            words >>= (uint32_t)distance.shift;
            if (distance.is_big)
                words = (words & 0xFF) << 8 | (words >> 8 & 0xFF);
            const Ints value = (Ints)(words & (uint32_t)distance.mask);
            const Ints keep = value > silent;
            memcpy(planes->keep + element, &keep, sizeof keep);
            if (!bits_of(keep)) {
                store(planes->range_m + element, (Floats){0});
                continue;
            }
            store(planes->range_m + element,
                  __builtin_convertvector(value & keep, Floats) * factor / divisor);
            memcpy(&words, levels + beam * (int64_t)sizeof(uint32_t), sizeof words);
            store(planes->level + element,
                  __builtin_convertvector((Ints)field_of(&level, words), Floats));
        }
        if (group->has_reflectivity)
            read_reflectivities(planes->words_at[fields[REFLECTIVITY].word], fields + REFLECTIVITY,
                                width, planes->reflectivity + which * width);
    }
}

/* -- points ------------------------------------------------------------------------------------ */

/* Row of the table of a TABLED group. */
static int64_t table_row(const Group *group, int64_t member, int64_t encoder)
{
    const int64_t row = encoder + group->first_row[member];
    return row < 0 ? 0 : row >= group->rows ? group->rows - 1 : row;
}

/* Speed of the rotor in a rotor word, radians in a ns. */
static float speed_of(int64_t encoder)
{
    const int64_t field = encoder >> SPEED_BIT & (2 * SPEED_SIGN - 1);
    /* The constant is 2 pi / 2**48 as Python computes it. */
    return (float)((double)((field ^ SPEED_SIGN) - SPEED_SIGN) * (0x1p-48 * 2 * 3.141592653589793));
}

/* What the projection of beams needs besides ranges; vectors as in `Group`. */
typedef struct {
    int64_t width;
    int64_t used;
    const float *direction; /* (3 vectors, 3 axes, width) */
    const float *origin;    /* as direction; has_origin: (3,), one for all */
    const float *reach;     /* or NULL */
    const float *firing_ns; /* or NULL */
    float cosine, sine, speed;
} Beams;

/* cos * V1 + sin * V2 + V3 of one axis, of the vectors in `used`. */
static inline Floats combine(const float *vectors, int64_t width, int64_t used, Floats cosine,
                             Floats sine)
{
    const Floats third = load(vectors + 6 * width);
    if (!(used & 1))
        return third;
    const Floats turned = cosine * load(vectors) + sine * load(vectors + 3 * width);
    return used >> 3 & 1 ? turned + third : turned;
}

/* (r + reach) * direction + origin of the beams from `beam`. */
FOR_CONSTANTS void place(const Beams *beams, int has_origin, int64_t used, int64_t beam,
                         Floats range_m, Floats *xyz)
{
    const int64_t width = beams->width;
    Floats cosine = (Floats){0} + beams->cosine, sine = (Floats){0} + beams->sine;
    if (beams->firing_ns) {
        const Floats turned = beams->speed * load(beams->firing_ns + beam);
        const Floats half = turned * 0.5f;
        const Floats before = cosine, across = sine;
        cosine = before - (half * before + across) * turned;
        sine = across + (before - half * across) * turned;
    }
    if (beams->reach)
        range_m += load(beams->reach + beam);
    for (int axis = 0; axis < AXES; axis++) {
        const int64_t first = axis * width + beam;
        const Floats along =
            combine(beams->direction + first, width, used >> axis, cosine, sine);
        if (has_origin)
            xyz[axis] = range_m * along + beams->origin[axis];
        else
            xyz[axis] = range_m * along
                + combine(beams->origin + first, width, used >> (6 + axis), cosine, sine);
    }
}

/* Points of all returns; undefined for beams without any range. */
FOR_CONSTANTS void place_all(const Beams *beams, int has_origin, int64_t used, int64_t returns,
                             const float *ranges_m, Planes *planes)
{
    for (int64_t which = 0; which < returns; which++)
        for (int64_t beam = 0, element = which * beams->width; beam < beams->width;
             beam += LANES, element += LANES) {
            Floats xyz[AXES];
            if (!bits_of(load_keep(planes->keep + element)))
                continue;
            place(beams, has_origin, used, beam, load(ranges_m + element), xyz);
            for (int axis = 0; axis < AXES; axis++)
                store(planes->xyz[axis] + element, xyz[axis]);
        }
}

/* Tabled: all beams at the angle of a row of the table. */
static void project_tabled(const Group *group, int64_t member, int64_t encoder, Planes *planes)
{
    const int64_t width = group->width, row = table_row(group, member, encoder);
    const Beams beams = {
        .width = width,
        .used = group->used[member],
        .direction = group->direction + member * 9 * width,
        .origin = group->origin + row * 3,
        .reach = group->reach + member * width,
        .cosine = group->cosine[row],
        .sine = group->sine[row],
    };
    if (beams.used == UPRIGHT_VECTORS)
        place_all(&beams, 1, UPRIGHT_VECTORS, group->returns, planes->range_m, planes);
    else
        place_all(&beams, 1, beams.used, group->returns, planes->range_m, planes);
}

/* Ranges from the point where beams pass the axis, of ranges from the axis. */
static void to_axis(const float *restrict range_m, const float *restrict miss_m2, int64_t width,
                    float *restrict out)
{
    for (int64_t beam = 0; beam < width; beam++) {
        const float behind_m2 = range_m[beam] * range_m[beam] - miss_m2[beam];
        out[beam] = sqrtf(behind_m2 > 0.0f ? behind_m2 : 0.0f);
    }
}

/* Points so near that they are projected from the axis, `beams->origin`. */
static void place_near(const Beams *beams, int64_t first, Planes *planes)
{
    const float nearest_m = 0.09f;
    for (int64_t beam = 0; beam < beams->width; beam += LANES) {
        const Floats range_m = load(planes->range_m + first + beam);
        const Ints is_near = (range_m > 0.0f) & (range_m <= nearest_m);
        if (!bits_of(is_near))
            continue;
        Floats xyz[AXES];
        place(beams, 1, beams->used, beam, range_m, xyz);
        for (int axis = 0; axis < AXES; axis++)
            for (int lane = 0; lane < LANES; lane++)
                if (is_near[lane])
                    planes->xyz[axis][first + beam + lane] = xyz[axis][lane];
    }
}

/* Turning: each beam fires at its own angle of the rotor. */
static void project_turning(const Group *group, int64_t member, int64_t encoder, int64_t table,
                            int64_t column, Planes *planes)
{
    const int64_t width = group->width;
    const float speed = speed_of(encoder);
    Beams beams = {
        .width = width,
        .used = group->used[member],
        .direction = group->direction + member * 9 * width,
        .origin = group->origin + member * 9 * width,
        .reach = group->reach ? group->reach + member * width : 0,
        .firing_ns = group->firing_ns && speed != 0.0f ? group->firing_ns + table * width : 0,
        .cosine = group->cosine[column],
        .sine = group->sine[column],
        .speed = speed,
    };
    if (!group->miss_m2) {
        place_all(&beams, 0, beams.used, group->returns, planes->range_m, planes);
        return;
    }
    _Alignas(64) float ranges_m[MOST_ELEMENTS];
    for (int64_t which = 0; which < group->returns; which++)
        to_axis(planes->range_m + which * width, group->miss_m2 + member * width, width,
                ranges_m + which * width);
    place_all(&beams, 0, beams.used, group->returns, ranges_m, planes);
    beams.reach = 0;
    beams.origin = group->axis_m + 3 * member;
    for (int64_t which = 0; which < group->returns; which++)
        place_near(&beams, which * width, planes);
}

/* Corrected: the correction of a range depends on the position of the point (docs/sources/
   velodyne.md section 10): interpolated below 25.04 m, for each axis. */
static void project_corrected(const Group *group, int64_t encoder, int64_t table, int64_t column,
                              Planes *planes)
{
    const float far_m = 25.04f;
    const int64_t width = group->width;
    const float *plane = group->planes, *pose = group->pose;
    const float *firing_ns = group->firing_ns + table * width;
    const float speed = speed_of(encoder);
    const float cosine = group->cosine[column], sine = group->sine[column];
    for (int64_t beam = 0; beam < width; beam++) {
        const float *own = plane + beam;
        const float turn_cosine = own[TURN_COSINE * width], turn_sine = own[TURN_SINE * width];
        const float first_cosine = cosine * turn_cosine + sine * turn_sine;
        const float first_sine = sine * turn_cosine - cosine * turn_sine;
        const float turned = speed * firing_ns[beam];
        const float half = turned * 0.5f;
        const float ahead = first_cosine - turned * (first_sine + half * first_cosine);
        const float aside = first_sine + turned * (first_cosine - half * first_sine);
        const float flat = own[FLAT * width];
        for (int64_t which = 0; which < group->returns; which++) {
            const int64_t element = which * width + beam;
            const float range_m = planes->range_m[element];
            const float far = range_m + own[FAR_M * width];
            float right_m = far, forward_m = far, up_m = far;
            if (range_m < far_m) {
                const float flat_m = far * flat;
                const float by_right = own[RIGHT_M * width]
                    + own[RIGHT_SLOPE * width] * fabsf(flat_m * aside);
                const float by_forward = own[FORWARD_M * width]
                    + own[FORWARD_SLOPE * width] * fabsf(flat_m * ahead);
                right_m = range_m + by_right;
                forward_m = range_m + by_forward;
                up_m = range_m + (by_right + by_forward) * 0.5f;
            }
            const float right = right_m * flat * aside - own[ASIDE_M * width] * ahead;
            const float forward = forward_m * flat * ahead + own[ASIDE_M * width] * aside;
            const float up = up_m * own[UP * width] + own[ABOVE_M * width];
            for (int axis = 0; axis < AXES; axis++) {
                const float *row = pose + POINT * axis;
                planes->xyz[axis][element] =
                    row[0] * forward - row[1] * right + row[2] * up + row[3];
            }
        }
    }
}

/* Rotate a direction by a small angle, below 0.05 rad: the next terms are d**5 / 120. */
static inline void rotate(float *cosine, float *sine, float more)
{
    const float square = more * more;
    const float by_sine = (square * (float)(-1.0 / 6) + 1.0f) * more;
    const float by_cosine = (square * (float)(1.0 / 24) - 0.5f) * square + 1.0f;
    const float before = *cosine;
    *cosine = before * by_cosine - *sine * by_sine;
    *sine = *sine * by_cosine + before * by_sine;
}

/* Corrections of azimuth and elevation of the beams of a column, by the cells of the tables over
   the rotor angle. */
static void correct_mirrored(const Group *group, int64_t encoder, const float *firing_ns,
                             float *restrict azimuth, float *restrict elevation)
{
    const double revolution = 2 * 3.141592653589793;
    const float speed = speed_of(encoder);
    const double steps_per_rad = (double)group->steps / revolution;
    const double angle = (double)(encoder & 0xFFFFFFFF) * (revolution / 4294967296.0);
    const double steps = angle * steps_per_rad;
    const int64_t step = (int64_t)steps;
    const float within = (float)(steps - (double)step);
    for (int64_t beam = 0; beam < group->beams; beam++) {
        const float turned = speed * firing_ns[beam];
        /* While a column is fired, beams may enter the next or the previous cells. */
        float part = turned * (float)steps_per_rad + within;
        int64_t further = (int64_t)part;
        further -= part < (float)further;
        part -= (float)further;
        int64_t row = step + further;
        if (row < 0 || row >= group->steps)
            row = (row % group->steps + group->steps) % group->steps;
        const int64_t cell = row * group->beams + beam;
        azimuth[beam] = group->azimuth_slope[cell] * part + group->azimuth_value[cell]
            + 2.0f * turned;
        elevation[beam] = group->elevation_slope[cell] * part + group->elevation_value[cell];
    }
}

/* Mirrored: a beam leaves at twice the angle of the rotor past the start of its mirror, whose
   cosine and sine are those of the column, and is corrected by tables over the rotor angle
   (docs/sources/hesai.md section 6). */
static void project_mirrored(const Group *group, int64_t encoder, int64_t table, int64_t column,
                             Planes *planes)
{
    float azimuth[MOST_BEAMS] = {0}, elevation[MOST_BEAMS] = {0};
    const int64_t width = group->width;
    const float *restrict plane = group->planes;
    const float *restrict pose = group->pose;
    const float past_cosine = group->cosine[column], past_sine = group->sine[column];
    correct_mirrored(group, encoder, group->firing_ns + table * width, azimuth, elevation);
    for (int64_t which = 0; which < group->returns; which++) {
        const float *restrict range_m = planes->range_m + which * width;
        float *restrict x = planes->xyz[0] + which * width;
        float *restrict y = planes->xyz[1] + which * width;
        float *restrict z = planes->xyz[2] + which * width;
        for (int64_t beam = 0; beam < width; beam++) {
            const float azimuth_cosine = plane[AZIMUTH_COSINE * width + beam];
            const float azimuth_sine = plane[AZIMUTH_SINE * width + beam];
            float cosine = past_cosine * azimuth_cosine - past_sine * azimuth_sine;
            float sine = past_sine * azimuth_cosine + past_cosine * azimuth_sine;
            rotate(&cosine, &sine, azimuth[beam]);
            float flat = plane[ELEVATION_COSINE * width + beam];
            float up = plane[ELEVATION_SINE * width + beam];
            rotate(&flat, &up, elevation[beam]);
            const float right = flat * sine, forward = flat * cosine;
            x[beam] = pose[3]
                + range_m[beam] * (right * pose[0] + forward * pose[1] + up * pose[2]);
            y[beam] = pose[7]
                + range_m[beam] * (right * pose[4] + forward * pose[5] + up * pose[6]);
            z[beam] = pose[11]
                + range_m[beam] * (right * pose[8] + forward * pose[9] + up * pose[10]);
        }
    }
}

static double sine_of(const Group *group, int64_t angle_cdeg)
{
    return (double)group->sines[angle_cdeg % 36000];
}

/* Coordinates: the one point of a record, as integers; one return after the other. */
static void read_coordinates(const Group *group, int64_t member, const uint8_t *record,
                             Planes *planes)
{
    const double *pose = group->pose_f8 + 12 * member;
    memset(planes->keep, 0, (size_t)(group->returns * group->width) * sizeof *planes->keep);
    for (int64_t which = 0; which < group->returns; which++, record += group->step) {
        const int64_t element = which * group->width;
        double x, y, z, range_m;
        if (group->coordinates == SPHERICAL_MM) {
            uint32_t depth;
            uint16_t angles[2];
            memcpy(&depth, record, sizeof depth);
            memcpy(angles, record + 4, sizeof angles);
            range_m = depth / 1000.0;
            const double flat_m = range_m * sine_of(group, angles[0]);
            z = range_m * sine_of(group, angles[0] + 9000);
            x = flat_m * sine_of(group, angles[1] + 9000);
            y = flat_m * sine_of(group, angles[1]);
        } else {
            int32_t wide[3];
            int16_t narrow[3];
            const int is_wide = group->coordinates == INT32_MM;
            memcpy(wide, record, is_wide ? sizeof wide : 0);
            memcpy(narrow, record, sizeof narrow);
            const double unit = is_wide ? 1000.0 : 100.0;
            x = (is_wide ? wide[0] : narrow[0]) / unit;
            y = (is_wide ? wide[1] : narrow[1]) / unit;
            z = (is_wide ? wide[2] : narrow[2]) / unit;
            range_m = sqrt(x * x + y * y + z * z);
        }
        planes->range_m[element] = (float)range_m;
        planes->keep[element] = -(int32_t)(planes->range_m[element] > 0.0f);
        planes->level[element] = (float)record[group->runs[0]];
        planes->xyz[0][element] = (float)(x * pose[0] + y * pose[1] + z * pose[2] + pose[3]);
        planes->xyz[1][element] = (float)(x * pose[4] + y * pose[5] + z * pose[6] + pose[7]);
        planes->xyz[2][element] = (float)(x * pose[8] + y * pose[9] + z * pose[10] + pose[11]);
    }
}

/* Rotate and shift points; turn, shift_m: first of the three rows, which are that far apart. */
static void move(const float *turn, int64_t turn_step, const float *shift_m, int64_t shift_step,
                 int64_t elements, Planes *planes)
{
    float *restrict x = planes->xyz[0];
    float *restrict y = planes->xyz[1];
    float *restrict z = planes->xyz[2];
    const float *second = turn + turn_step, *third = turn + 2 * turn_step;
    const float rows[AXES][POINT] = {
        {turn[0], turn[1], turn[2], shift_m[0]},
        {second[0], second[1], second[2], shift_m[shift_step]},
        {third[0], third[1], third[2], shift_m[2 * shift_step]},
    };
    for (int64_t element = 0; element < elements; element++) {
        const float x_m = x[element], y_m = y[element], z_m = z[element];
        x[element] = x_m * rows[0][0] + y_m * rows[0][1] + z_m * rows[0][2] + rows[0][3];
        y[element] = x_m * rows[1][0] + y_m * rows[1][1] + z_m * rows[1][2] + rows[1][3];
        z[element] = x_m * rows[2][0] + y_m * rows[2][1] + z_m * rows[2][2] + rows[2][3];
    }
}

/* Placed: points that a driver computed, rotated and shifted; their ranges count from axis_m. */
static void read_placed(const Group *group, int64_t member, const uint8_t *record, Planes *planes)
{
    const size_t bytes = (size_t)group->beams * sizeof(float);
    const uint8_t *from = record + group->runs[0];
    float *restrict x = planes->xyz[0];
    float *restrict y = planes->xyz[1];
    float *restrict z = planes->xyz[2];
    float *restrict range_m = planes->range_m;
    for (int axis = 0; axis < AXES; axis++) {
        memcpy(planes->xyz[axis], from + (size_t)axis * bytes, bytes);
        for (int64_t beam = group->beams; beam < group->width; beam++)
            planes->xyz[axis][beam] = 0;
    }
    memcpy(planes->level, from + AXES * bytes, bytes);
    int32_t *restrict keep = planes->keep;
    for (int64_t beam = 0; beam < group->width; beam++) {
        range_m[beam] = sqrtf(x[beam] * x[beam] + y[beam] * y[beam] + z[beam] * z[beam]);
        keep[beam] = -(int32_t)(range_m[beam] > 0.0f);
    }
    const float *axis_m = group->axis_m;
    for (int64_t beam = 0; axis_m && beam < group->beams; beam++) {
        const float side_m[AXES] = {x[beam] - axis_m[0], y[beam] - axis_m[1], z[beam] - axis_m[2]};
        range_m[beam] = sqrtf(side_m[0] * side_m[0] + side_m[1] * side_m[1] + side_m[2] * side_m[2]);
    }
    if (group->runs[1]) {
        memset(planes->label, 0, (size_t)group->width * sizeof *planes->label);
        memcpy(planes->label, record + group->runs[1], (size_t)group->beams * sizeof *planes->label);
    }
    move(group->direction + 9 * member, 3, group->origin + 3 * member, 1, group->width, planes);
}

/* -- which slots become points ----------------------------------------------------------------- */

static int64_t count_kept(const int32_t *restrict keep, int64_t elements)
{
    int32_t total = 0;
    for (int64_t element = 0; element < elements; element++)
        total -= keep[element];
    return total;
}

/* Leave out returns that are the same as an earlier one of their shot. */
static void drop_repeated(const Group *group, Planes *planes)
{
    const int64_t width = group->width;
    for (int64_t which = 1; which < group->returns; which++)
        for (int64_t earlier = 0; earlier < which; earlier++) {
            const float *restrict later_m = planes->range_m + which * width;
            const float *restrict earlier_m = planes->range_m + earlier * width;
            int32_t *restrict keep = planes->keep + which * width;
            for (int64_t beam = 0; beam < width; beam++)
                keep[beam] &= -(int32_t)(later_m[beam] != earlier_m[beam]);
        }
}

static void drop_inside(const float *box, int64_t elements, Planes *planes)
{
    const float *restrict x = planes->xyz[0];
    const float *restrict y = planes->xyz[1];
    const float *restrict z = planes->xyz[2];
    int32_t *restrict keep = planes->keep;
    for (int64_t element = 0; element < elements; element++) {
        const int32_t inside = (x[element] >= box[0]) & (x[element] <= box[3])
            & (y[element] >= box[1]) & (y[element] <= box[4])
            & (z[element] >= box[2]) & (z[element] <= box[5]);
        keep[element] &= inside - 1;
    }
}

static int has_filters(const Scan *scan, const Group *group)
{
    return group->drops_repeated || group->limits_m || scan->box_count;
}

/* Drop elements by all filters; count those left after each. */
static void mark(const Scan *scan, const Group *group, int64_t member, Planes *planes)
{
    const int64_t elements = group->returns * group->width;
    const float *restrict range_m = planes->range_m;
    int32_t *restrict keep = planes->keep;
    int64_t *counts = group->counts + member * COUNTS;
    int64_t left = count_kept(keep, elements);
    counts[FOUND] += left;
    if (group->drops_repeated) {
        drop_repeated(group, planes);
        left = count_kept(keep, elements);
    }
    counts[DISTINCT] += left;
    if (group->limits_m) {
        const float low = group->limits_m[2 * member], high = group->limits_m[2 * member + 1];
        for (int64_t element = 0; element < elements; element++)
            keep[element] &= -(int32_t)((range_m[element] >= low) & (range_m[element] <= high));
        left = count_kept(keep, elements);
    }
    counts[IN_RANGE] += left;
    for (int64_t number = 0; number < scan->box_count; number++)
        drop_inside(scan->boxes_m + 6 * number, elements, planes);
    if (scan->box_count)
        left = count_kept(keep, elements);
    counts[OUTSIDE_BOXES] += left;
}

/* Labels of all elements at time 0; types of dual returns: docs/sources/outputs.md section 3. */
static const int64_t *labels_of(const Group *group, int64_t known, Planes *planes)
{
    enum { FIRST_STRONG = 3, SINGLE = 7, SUM_OF_TYPES = 9 };
    const int64_t width = group->width;
    const int64_t *words = group->labels + known * group->returns * width;
    if (group->kind == PLACED && group->runs[1]) {
        for (int64_t beam = 0; beam < width; beam++)
            planes->label[beam] |= (int64_t)((uint64_t)words[beam] >> LIDAR_ID_BIT << LIDAR_ID_BIT);
        return planes->label;
    }
    if (group->typed == NOT_TYPED)
        return words;
    const int by_level = group->typed == TYPED_BY_LEVEL;
    const float *restrict range_m = planes->range_m;
    const float *restrict level = planes->level;
    int64_t *restrict labels = planes->label;
    for (int64_t beam = 0; beam < width; beam++) {
        const float first_m = range_m[beam], second_m = range_m[width + beam];
        const int32_t kind = FIRST_STRONG + (first_m > second_m)
            + 2 * (by_level & (level[beam] < level[width + beam]));
        const int32_t is_single = (first_m == 0.0f) | (second_m == 0.0f)
            | ((group->sends_twice != 0) & (first_m == second_m));
        const int32_t single = is_single ? SINGLE : 0;
        labels[beam] = words[beam] | (int64_t)(kind | single) << TYPE_BIT;
        labels[width + beam] = words[width + beam]
            | (int64_t)((SUM_OF_TYPES - kind) | single) << TYPE_BIT;
    }
    return labels;
}

/* -- rows -------------------------------------------------------------------------------------- */

/* A point: x, y, z, level. */
typedef float Point __attribute__((vector_size(16)));

/* Interleave numbers of two vectors, from the first or the second half of each four; by pairs. */
#if LANES == 8
#define FIRST(a, b) SHUFFLE(Ints, a, b, 0, 8, 1, 9, 4, 12, 5, 13)
#define SECOND(a, b) SHUFFLE(Ints, a, b, 2, 10, 3, 11, 6, 14, 7, 15)
#define FIRST_PAIRS(a, b) SHUFFLE(Ints, a, b, 0, 1, 8, 9, 4, 5, 12, 13)
#define SECOND_PAIRS(a, b) SHUFFLE(Ints, a, b, 2, 3, 10, 11, 6, 7, 14, 15)
#else
#define FIRST(a, b) SHUFFLE(Ints, a, b, 0, 4, 1, 5)
#define SECOND(a, b) SHUFFLE(Ints, a, b, 2, 6, 3, 7)
#define FIRST_PAIRS(a, b) SHUFFLE(Ints, a, b, 0, 1, 4, 5)
#define SECOND_PAIRS(a, b) SHUFFLE(Ints, a, b, 2, 3, 6, 7)
#endif

enum { NAN_BITS = 0x7FC00000 };

/* Elements of a plane; blanks: NaN for elements that are not kept. */
static inline Floats load_kept(const float *plane, Ints keep, int blanks)
{
    const Floats values = load(plane);
    return blanks ? (Floats)(((Ints)values & keep) | (NAN_BITS & ~keep)) : values;
}

/* Points of LANES elements: of 4 * k + n in part k of vector n. */
static inline void transpose(const Planes *planes, int64_t element, int blanks, Floats *points)
{
    const Ints keep = load_keep(planes->keep + element);
    const Floats x = load_kept(planes->xyz[0] + element, keep, blanks);
    const Floats y = load_kept(planes->xyz[1] + element, keep, blanks);
    const Floats z = load_kept(planes->xyz[2] + element, keep, blanks);
    const Floats level = load_kept(planes->level + element, keep, blanks);
    const Floats low = FIRST(x, y), high = SECOND(x, y);
    const Floats low_rest = FIRST(z, level), high_rest = SECOND(z, level);
    points[0] = FIRST_PAIRS(low, low_rest);
    points[1] = SECOND_PAIRS(low, low_rest);
    points[2] = FIRST_PAIRS(high, high_rest);
    points[3] = SECOND_PAIRS(high, high_rest);
}

/* Rows of lanes 1, 2, 3 after that of lane 0, by the bits of the lanes that are kept, and how many
   are; all times two, so that processors can address a row of 16 or 8 bytes by it. */
static const uint8_t NEXT[16][4] = {
    {0, 0, 0, 0}, {2, 2, 2, 2}, {0, 2, 2, 2}, {2, 4, 4, 4}, {0, 0, 2, 2}, {2, 2, 4, 4},
    {0, 2, 4, 4}, {2, 4, 6, 6}, {0, 0, 0, 2}, {2, 2, 2, 4}, {0, 2, 2, 4}, {2, 4, 4, 6},
    {0, 0, 2, 4}, {2, 2, 4, 6}, {0, 2, 4, 6}, {2, 4, 6, 8},
};

/* Store kept elements in the order of their numbers; a point that is not kept is overwritten by the
   next one. No branch depends on what is kept but for lanes without any, since processors would
   often predict it wrongly. Return the next row. */
static int64_t emit_natural(const Scan *scan, int64_t elements, const int64_t *words,
                            int64_t offset_ns, int64_t row, const Planes *planes)
{
    uint8_t *points = (uint8_t *)(scan->point + POINT * row);
    uint8_t *labels = (uint8_t *)(scan->label + row);
    for (int64_t element = 0; element < elements; element += LANES) {
        int kept = bits_of(load_keep(planes->keep + element));
        if (!kept)
            continue;
        Floats vectors[4];
        transpose(planes, element, 0, vectors);
        for (int part = 0; part < LANES; part += 4, kept >>= 4) {
            const uint8_t *next = NEXT[kept & 15];
            for (int lane = 0; lane < 4; lane++) {
                const int64_t twice = lane ? next[lane - 1] : 0;
                const int64_t label = words[element + part + lane] + offset_ns;
                memcpy(points + 8 * twice, (const float *)(vectors + lane) + part, sizeof(Point));
                memcpy(labels + 4 * twice, &label, sizeof label);
            }
            points += 8 * (size_t)next[3];
            labels += 4 * (size_t)next[3];
        }
    }
    return (int64_t *)(void *)labels - scan->label;
}

/* All points of a column. */
static void transpose_all(int64_t elements, int blanks, float (*out)[POINT], const Planes *planes)
{
    for (int64_t element = 0; element < elements; element += LANES) {
        Floats vectors[4];
        transpose(planes, element, blanks, vectors);
        for (int lane = 0; lane < LANES; lane++)
            memcpy(out[element + lane], (const float *)(vectors + lane % 4) + lane / 4 * 4,
                   sizeof(Point));
    }
}

/* The same in another order, or of a number of elements that is no multiple of LANES. */
static int64_t emit_ordered(const Scan *scan, const Group *group, const int64_t *order,
                            const int64_t *labels, int64_t offset_ns, int64_t row,
                            const Planes *planes)
{
    float *restrict point = scan->point;
    int64_t *restrict label = scan->label;
    for (int64_t number = 0; number < group->slots; number++) {
        const int64_t element = order ? order[number] : number;
        memcpy(point + POINT * row, planes->point[element], sizeof planes->point[element]);
        label[row] = labels[element] + offset_ns;
        row -= planes->keep[element];
    }
    return row;
}

/* Ranges and reflectivities of the kept elements, in order of output. */
static void emit_extras(const Scan *scan, const Group *group, const int64_t *order, int64_t row,
                        const Planes *planes)
{
    for (int64_t number = 0; number < group->slots; number++) {
        const int64_t element = order ? order[number] : number;
        if (scan->range_m)
            scan->range_m[row] = planes->range_m[element];
        if (scan->reflectivity)
            scan->reflectivity[row] = group->has_reflectivity ? planes->reflectivity[element] : 0;
        row -= planes->keep[element];
    }
}

/* A column of a dense scan. Return the next row. */
static int64_t emit_dense(const Scan *scan, const Group *group, const int64_t *order,
                          const int64_t *labels, int64_t offset_ns, int64_t row, Planes *planes)
{
    if (scan->range_m || scan->reflectivity)
        emit_extras(scan, group, order, row, planes);
    if (!order && group->slots % LANES == 0)
        return emit_natural(scan, group->slots, labels, offset_ns, row, planes);
    transpose_all(group->returns * group->width, 0, planes->point, planes);
    return emit_ordered(scan, group, order, labels, offset_ns, row, planes);
}

static float not_a_number(void)
{
    const int32_t bits = NAN_BITS;
    float nan;
    memcpy(&nan, &bits, sizeof nan);
    return nan;
}

/* Number of the row of a column in the arrays of an organized scan. */
static int64_t organized_row(const Scan *scan, int64_t column)
{
    return scan->records ? column % scan->near_columns : scan->first_number + column;
}

/* Labels of elements; where an element is not kept, the label of an empty slot. */
static void to_labels(const int64_t *restrict words, int64_t offset_ns, int64_t empty,
                      int64_t elements, const int32_t *restrict keep, int64_t *restrict labels)
{
    for (int64_t element = 0; element < elements; element++)
        labels[element] = keep[element] ? words[element] + offset_ns : empty;
}

/* Ranges and reflectivities of a row of an organized scan. */
static void emit_slot_extras(const Scan *scan, const Group *group, int64_t first,
                             const Planes *planes)
{
    const float nan = not_a_number();
    float *range_m = scan->range_m ? scan->range_m + first : 0;
    uint16_t *reflectivity = scan->reflectivity ? scan->reflectivity + first : 0;
    for (int64_t slot = group->slots; range_m && slot < scan->row_slots; slot++)
        range_m[slot] = nan;
    for (int64_t slot = group->slots; reflectivity && slot < scan->row_slots; slot++)
        reflectivity[slot] = 0;
    for (int64_t which = 0; which < group->returns && (range_m || reflectivity); which++)
        for (int64_t beam = 0; beam < group->beams; beam++) {
            const int64_t element = which * group->width + beam;
            const int64_t slot = group->slot ? group->slot[element] : element;
            const int is_kept = planes->keep[element] != 0;
            if (range_m)
                range_m[slot] = is_kept ? planes->range_m[element] : nan;
            if (reflectivity)
                reflectivity[slot] =
                    is_kept && group->has_reflectivity ? planes->reflectivity[element] : 0;
        }
}

/* The row of a column in an organized scan: every element to its slot, kept or empty. Return the
   number of points. */
static int64_t emit_organized(const Scan *scan, const Group *group, int64_t column,
                              const int64_t *words, int64_t offset_ns, Planes *planes)
{
    const int64_t width = group->width, elements = group->returns * width;
    const int64_t first = organized_row(scan, column) * mlbatch_row_step(scan);
    const int64_t empty = (int64_t)((uint64_t)words[0] >> LIDAR_ID_BIT << LIDAR_ID_BIT);
    const float nan = not_a_number();
    float(*restrict point)[POINT] = (float(*)[POINT])(void *)(scan->point + POINT * first);
    int64_t *restrict label = scan->label + first;
    const int32_t *keep = planes->keep;
    if (!group->slot && group->slots % LANES == 0) {
        transpose_all(group->slots, 1, point, planes);
        to_labels(words, offset_ns, empty, group->slots, keep, label);
    } else {
        transpose_all(elements, 1, planes->point, planes);
        for (int64_t which = 0; which < group->returns; which++)
            for (int64_t beam = 0; beam < group->beams; beam++) {
                const int64_t element = which * width + beam;
                const int64_t slot = group->slot ? group->slot[element] : element;
                memcpy(point[slot], planes->point[element], sizeof point[slot]);
                label[slot] = keep[element] ? words[element] + offset_ns : empty;
            }
    }
    for (int64_t slot = group->slots; slot < scan->row_slots; slot++) {
        for (int value = 0; value < POINT; value++)
            point[slot][value] = nan;
        label[slot] = empty;
    }
    emit_slot_extras(scan, group, first, planes);
    return count_kept(keep, elements);
}

/* -- columns ----------------------------------------------------------------------------------- */

static const uint8_t *record_of(const Scan *scan, const Group *group, int64_t column)
{
    Ring *ring = group->rings + scan->member_of[scan->sensor[column]];
    const int64_t index = scan->ring_index[column];
    const int64_t row = ring->per_row == 1 ? index : index / ring->per_row;
    if (row < ring->base || row >= ring->base + ring->rows) {
        const int64_t rest = (row - ring->base) % ring->rows;
        ring->base = row - (rest < 0 ? rest + ring->rows : rest);
    }
    return ring->first + (row - ring->base) * ring->row_bytes
        + (index - row * ring->per_row) * ring->column_bytes;
}

/* Ask for what a later column needs: neighbours in a scan are far apart in memory. Return its
   record, NULL: there is none. */
static const uint8_t *prefetched(const Scan *scan, int64_t column)
{
    enum { LINE = 64 };
    if (column >= scan->columns)
        return 0;
    const int64_t number = scan->group_of[scan->sensor[column]];
    if (number < 0)
        return 0;
    const Group *group = scan->groups + number;
    const uint8_t *record = record_of(scan, group, column);
    for (int64_t byte = 0; byte < group->step * group->beams; byte += LINE)
        __builtin_prefetch(record + byte);
    return record;
}

static int64_t decode_column(const Scan *scan, const Group *group, int64_t member, int64_t column,
                             const uint8_t *record, int64_t row, Planes *planes)
{
    const int64_t encoder = scan->encoder[column];
    int64_t table = encoder >> TABLE_BIT;
    table = table < 0 ? 0 : table >= group->tables ? group->tables - 1 : table;
    const int64_t known = member * group->tables + table;
    const int64_t offset_ns = scan->stamp_ns[column] - scan->start_ns;
    group->counts[member * COUNTS + COLUMNS]++;
    if (group->kind != PLACED && group->kind != COORDINATES)
        read_pixels(group, record, planes);
    switch (group->kind) {
    case PLACED: read_placed(group, member, record, planes); break;
    case COORDINATES: read_coordinates(group, member, record, planes); break;
    case CORRECTED: project_corrected(group, encoder, known, column, planes); break;
    case MIRRORED: project_mirrored(group, encoder, known, column, planes); break;
    case TABLED: project_tabled(group, member, encoder, planes); break;
    default: project_turning(group, member, encoder, known, column, planes);
    }
    const int is_filtered = has_filters(scan, group);
    if (is_filtered)
        mark(scan, group, member, planes);
    if (scan->moves) {
        const float *moves = scan->moves + 12 * column;
        move(moves, 4, moves + 3, 4, group->returns * group->width, planes);
    }
    const int64_t *labels = labels_of(group, known, planes);
    const int64_t *order = group->order ? group->order + table * group->order_step : 0;
    const int64_t next = scan->row_slots
        ? row + emit_organized(scan, group, column, labels, offset_ns, planes)
        : emit_dense(scan, group, order, labels, offset_ns, row, planes);
    for (int which = FOUND; which < COUNTS && !is_filtered; which++)
        group->counts[member * COUNTS + which] += next - row;
    return next;
}

/* Decode a column of a dense scan to packed records. Return the next row. */
static int64_t pack_column(const Scan *scan, const Group *group, int64_t member, int64_t column,
                           const uint8_t *record, int64_t row, Planes *planes)
{
    const Rows rows = {scan->point, scan->label, scan->range_m, scan->reflectivity, 1};
    const int64_t count = decode_column(scan, group, member, column, record, 0, planes);
    mlbatch_pack(scan, &rows, count, scan->records + row * scan->record_bytes);
    return row + count;
}

/* Decode all columns of a scan, in their order; return the row after the last point (organized:
   the number of points). Sensors of no group are skipped. */
static int64_t decode_columns(const Scan *scan)
{
    enum { AHEAD = 2 };
    Planes planes;
    const uint8_t *records[AHEAD] = {prefetched(scan, 0), prefetched(scan, 1)};
    int64_t row = scan->first_row;
    for (int64_t column = 0; column < scan->columns; column++) {
        const uint8_t *record = records[column % AHEAD];
        records[column % AHEAD] = prefetched(scan, column + AHEAD);
        const int64_t sensor = scan->sensor[column];
        const int64_t number = scan->group_of[sensor], member = scan->member_of[sensor];
        if (number < 0)
            continue;
        const Group *group = scan->groups + number;
        const int64_t first = row;
        if (scan->records && !scan->row_slots)
            row = pack_column(scan, group, member, column, record, row, &planes);
        else
            row = decode_column(scan, group, member, column, record, row, &planes);
        if (scan->records && scan->row_slots
            && (column % scan->near_columns == scan->near_columns - 1
                || column == scan->columns - 1))
            mlbatch_pack_rows(scan, column - column % scan->near_columns, column + 1);
        if (scan->column)
            for (int64_t point = first; point < row; point++)
                scan->column[point] = (uint32_t)(scan->first_number + column);
    }
    return row;
}

#if LANES == 4
#if defined(MLBATCH_WIDE)
static int has_wide;

/* Whether processor and operating system have AVX2, when the library is loaded; what compilers
   offer for it is not in all of them (Zig's denies always). */
__attribute__((constructor)) static void find_wide(void)
{
    enum { SAVED = 6 };
    uint32_t a, b, c, d, saved, rest;
    if (!__get_cpuid(1, &a, &b, &c, &d) || !(c & bit_OSXSAVE))
        return;
    __asm__("xgetbv" : "=a"(saved), "=d"(rest) : "c"(0));
    if ((saved & SAVED) == SAVED && __get_cpuid_count(7, 0, &a, &b, &c, &d))
        has_wide = (b & bit_AVX2) != 0;
}
#endif

EXPORT int64_t mlbatch_decode(const Scan *scan)
{
#if defined(MLBATCH_WIDE)
    if (has_wide)
        return mlbatch_decode_wide(scan);
#endif
    return decode_columns(scan);
}
#else
int64_t mlbatch_decode_wide(const Scan *scan)
{
    return decode_columns(scan);
}
#endif
