/* Columns of a window to points of a scan: every pixel is read once and written to its final row.

   Formulas: `lidar/geometry.py`, `lidar/projections.py`. A column is decoded to planes, one value a beam, which fit into the first cache; an element is
   `return * width + beam`. Beams beyond those of the lidar have no return. */
#include <math.h>
#include <string.h>

#include "native.h"

#if defined(__SSE2__)
#include <emmintrin.h>
#endif

#define MOST_ELEMENTS (MOST_BEAMS * MOST_RETURNS)
#define TYPE_BIT 48
#define LIDAR_ID_BIT 56
/* Rotor words: `lidar/geometry.py`. */
#define SPEED_BIT 32
#define SPEED_SIGN (INT64_C(1) << 23)
#define TABLE_BIT 56
/* The usual case of TABLED, as a kind: the axis of the rotor is vertical, so that vector 3 is zero
   for x and y, and vectors 1 and 2 are for z; with this many beams, so that vectors are constant
   distances apart. Bits as in `Group.used`. */
#define UPRIGHT (-1)
#define UPRIGHT_BEAMS 128
#define UPRIGHT_VECTORS 043
#define ALL_VECTORS 077

/* Planes of one column. */
typedef struct {
    _Alignas(64) float range_m[MOST_ELEMENTS];
    _Alignas(64) float level[MOST_ELEMENTS];
    _Alignas(64) float x[MOST_ELEMENTS];
    _Alignas(64) float y[MOST_ELEMENTS];
    _Alignas(64) float z[MOST_ELEMENTS];
    _Alignas(64) int64_t label[MOST_ELEMENTS];
    _Alignas(64) uint32_t words[MOST_WORDS][MOST_BEAMS];
    _Alignas(64) uint16_t reflectivity[MOST_ELEMENTS];
    _Alignas(64) uint8_t keep[MOST_ELEMENTS];
} Planes;

/* -- pixels ------------------------------------------------------------------------------------ */

/* Words of pixels that are `step` bytes apart. Words of short pixels reach up to 3 bytes beyond
   them; rings have that much room behind their last column. */
static inline void gather_every(const uint8_t *from, int64_t step, int64_t count, uint32_t *out)
{
    for (int64_t pixel = 0; pixel < count; pixel++)
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

/* Words of pixels at any places. */
static void gather_at(const uint8_t *from, const int64_t *places, int64_t count, uint32_t *out)
{
    for (int64_t pixel = 0; pixel < count; pixel++)
        memcpy(out + pixel, from + places[pixel], 4);
}

/* Swap the two bytes of a big-endian field; other bits of the words stay. */
static void swap_bytes(uint32_t *words, const Field *field, int64_t width)
{
    const int shift = (int)field->shift;
    const uint32_t others = ~(UINT32_C(0xFFFF) << shift);
    for (int64_t beam = 0; beam < width; beam++) {
        const uint32_t value = words[beam] >> shift;
        const uint32_t swapped = (value & 0xFF) << 8 | (value >> 8 & 0xFF);
        words[beam] = (words[beam] & others) | swapped << shift;
    }
}

static void to_ranges(const uint32_t *restrict words, const Field *field, int32_t silent,
                      const float *scale, int64_t width, float *restrict range_m)
{
    const int shift = (int)field->shift;
    const uint32_t mask = (uint32_t)field->mask;
    const float factor = scale[0], divisor = scale[1];
    for (int64_t beam = 0; beam < width; beam++) {
        const int32_t value = (int32_t)(words[beam] >> shift & mask);
        /* A mask instead of a branch, which would not be vectorised; 0 gives exactly 0 m. */
        range_m[beam] = (float)(value & -(int32_t)(value > silent)) * factor / divisor;
    }
}

static void to_levels(const uint32_t *restrict words, const Field *field, int64_t width,
                      float *restrict levels)
{
    const int shift = (int)field->shift;
    const uint32_t mask = (uint32_t)field->mask;
    for (int64_t beam = 0; beam < width; beam++)
        levels[beam] = (float)(int32_t)(words[beam] >> shift & mask);
}

static void to_reflectivities(const uint32_t *restrict words, const Field *field, int64_t width,
                              uint16_t *restrict reflectivity)
{
    const int shift = (int)field->shift;
    const uint32_t mask = (uint32_t)field->mask;
    for (int64_t beam = 0; beam < width; beam++)
        reflectivity[beam] = (uint16_t)(words[beam] >> shift & mask);
}

/* Words of the pixels of one return, of all channels; distances in little-endian order, 0 for
   channels without returns. */
static void read_words(const Group *group, const uint8_t *record, int64_t which, Planes *planes)
{
    const int64_t *run = group->runs + which * group->run_count * 3;
    const int64_t *bytes = group->word_bytes + which * group->word_count;
    for (int64_t word = 0; group->places && word < group->word_count; word++)
        gather_at(record + bytes[word], group->places, group->slots, planes->words[word]);
    for (int64_t number = 0; !group->places && number < group->run_count; number++, run += 3)
        for (int64_t word = 0; word < group->word_count; word++)
            gather(record + run[0] + bytes[word], group->step, run[2],
                   planes->words[word] + run[1]);
    const Field *distance = group->fields + which * FIELDS + DISTANCE;
    uint32_t *words = planes->words[distance->word];
    if (distance->is_big)
        swap_bytes(words, distance, group->width);
    for (int64_t number = 0; number < group->dark_count; number++)
        words[group->dark[number]] &= ~((uint32_t)distance->mask << (int)distance->shift);
}

/* Range, level and reflectivity of one return of a column. */
static void read_return(const Group *group, const uint8_t *record, int64_t which, Planes *planes)
{
    const int64_t width = group->width, first = which * width;
    const Field *fields = group->fields + which * FIELDS;
    read_words(group, record, which, planes);
    to_ranges(planes->words[fields[DISTANCE].word], fields + DISTANCE, (int32_t)group->silent,
              group->scale, width, planes->range_m + first);
    to_levels(planes->words[fields[INTENSITY].word], fields + INTENSITY, width,
              planes->level + first);
    if (group->has_reflectivity)
        to_reflectivities(planes->words[fields[REFLECTIVITY].word], fields + REFLECTIVITY, width,
                          planes->reflectivity + first);
}

/* -- points ------------------------------------------------------------------------------------ */

/* Row of the table of a TABLED group. */
static int64_t table_row(const Group *group, int64_t member, int64_t encoder)
{
    const int64_t row = encoder + group->first_row[member];
    return row < 0 ? 0 : row >= group->rows ? group->rows - 1 : row;
}

/* One coordinate: (r + reach) * (cos * V1 + sin * V2 + V3) + origin. */
static inline void place(const float *restrict range_m, const float *restrict reach,
                         const float *restrict vectors, int64_t width, float cosine, float sine,
                         float origin, float *restrict out)
{
    const float *restrict second = vectors + 3 * width;
    const float *restrict third = vectors + 6 * width;
    for (int64_t beam = 0; beam < width; beam++) {
        const float direction = cosine * vectors[beam] + sine * second[beam] + third[beam];
        out[beam] = (range_m[beam] + reach[beam]) * direction + origin;
    }
}

/* Tabled: all beams at the angle of a row of the table. */
static void project_tabled(const Group *group, int64_t member, int64_t encoder, Planes *planes)
{
    const int64_t width = group->width;
    const int64_t row = table_row(group, member, encoder);
    const float *restrict vectors = group->direction + member * 9 * width;
    const float *restrict reach = group->reach + member * width;
    const float *origin = group->origin + row * 3;
    const float cosine = group->cosine[row], sine = group->sine[row];
    for (int64_t which = 0; which < group->returns; which++) {
        const float *range_m = planes->range_m + which * width;
        float *planes_of[] = {planes->x, planes->y, planes->z};
        for (int64_t axis = 0; axis < 3; axis++)
            place(range_m, reach, vectors + axis * width, width, cosine, sine, origin[axis],
                  planes_of[axis] + which * width);
    }
}

/* cos * V1 + sin * V2 + V3 of one axis; vectors that are zero are left out. */
static void combine(const float *restrict vectors, int64_t width, int64_t used,
                    const float *restrict cosine, const float *restrict sine, float *restrict out)
{
    const float *restrict first = vectors;
    const float *restrict second = vectors + 3 * width;
    const float *restrict third = vectors + 6 * width;
    const int rotates = used & 1, is_constant = used >> 3 & 1;
    if (!rotates) {
        memcpy(out, third, (size_t)width * sizeof *out);
    } else if (!is_constant) {
        for (int64_t beam = 0; beam < width; beam++)
            out[beam] = cosine[beam] * first[beam] + sine[beam] * second[beam];
    } else {
        for (int64_t beam = 0; beam < width; beam++)
            out[beam] = cosine[beam] * first[beam] + sine[beam] * second[beam] + third[beam];
    }
}

/* Speed of the rotor in a rotor word, radians in a ns. */
static float speed_of(int64_t encoder)
{
    const int64_t field = encoder >> SPEED_BIT & (2 * SPEED_SIGN - 1);
    /* The constant is 2 pi / 2**48 as Python computes it. */
    return (float)((double)((field ^ SPEED_SIGN) - SPEED_SIGN) * (0x1p-48 * 2 * 3.141592653589793));
}

/* Square roots of a multiple of four numbers; all compilers round them correctly. */
static void take_roots(float *values, int64_t count)
{
#if defined(__SSE2__)
    for (int64_t at = 0; at < count; at += 4)
        _mm_storeu_ps(values + at, _mm_sqrt_ps(_mm_loadu_ps(values + at)));
#else
    for (int64_t at = 0; at < count; at++)
        values[at] = sqrtf(values[at]);
#endif
}

/* Points so near that they are projected from the axis. */
static void place_near(const float *axis_m, const float *range_m,
                       float (*direction)[MOST_BEAMS], int64_t width, float *x, float *y, float *z)
{
    const float nearest_m = 0.09f;
    for (int64_t beam = 0; beam < width; beam++)
        if (range_m[beam] > 0.0f && range_m[beam] <= nearest_m) {
            x[beam] = range_m[beam] * direction[0][beam] + axis_m[0];
            y[beam] = range_m[beam] * direction[1][beam] + axis_m[1];
            z[beam] = range_m[beam] * direction[2][beam] + axis_m[2];
        }
}

/* Turning: each beam fires at its own angle of the rotor. */
static void project_turning(const Group *group, int64_t member, int64_t encoder, int64_t table,
                            int64_t column, Planes *planes)
{
    _Alignas(64) float cosine[MOST_BEAMS], sine[MOST_BEAMS];
    _Alignas(64) float direction[3][MOST_BEAMS], origin[3][MOST_BEAMS];
    const int64_t width = group->width;
    const float speed = speed_of(encoder);
    for (int64_t beam = 0; beam < width; beam++) {
        cosine[beam] = group->cosine[column];
        sine[beam] = group->sine[column];
    }
    if (group->firing_ns && speed != 0.0f) {
        const float *restrict firing_ns = group->firing_ns + table * width;
        for (int64_t beam = 0; beam < width; beam++) {
            const float before = cosine[beam], across = sine[beam];
            const float turned = speed * firing_ns[beam];
            const float half = turned * 0.5f;
            cosine[beam] = before - (half * before + across) * turned;
            sine[beam] = across + (before - half * across) * turned;
        }
    }
    const float *directions = group->direction + member * 9 * width;
    const float *origins = group->origin + member * 9 * width;
    const int64_t used = group->used[member];
    for (int64_t axis = 0; axis < 3; axis++) {
        combine(directions + axis * width, width, used >> axis, cosine, sine, direction[axis]);
        combine(origins + axis * width, width, used >> (6 + axis), cosine, sine, origin[axis]);
    }
    for (int64_t which = 0; which < group->returns; which++) {
        const float *restrict range_m = planes->range_m + which * width;
        if (group->miss_m2) {
            const float *restrict miss_m2 = group->miss_m2 + member * width;
            for (int64_t beam = 0; beam < width; beam++) {
                const float behind_m2 = range_m[beam] * range_m[beam] - miss_m2[beam];
                sine[beam] = behind_m2 > 0.0f ? behind_m2 : 0.0f;
            }
            take_roots(sine, width);
            range_m = sine;
        }
        if (group->reach) {
            const float *restrict reach = group->reach + member * width;
            for (int64_t beam = 0; beam < width; beam++)
                cosine[beam] = range_m[beam] + reach[beam];
            range_m = cosine;
        }
        float *restrict x = planes->x + which * width;
        float *restrict y = planes->y + which * width;
        float *restrict z = planes->z + which * width;
        for (int64_t beam = 0; beam < width; beam++) {
            x[beam] = range_m[beam] * direction[0][beam] + origin[0][beam];
            y[beam] = range_m[beam] * direction[1][beam] + origin[1][beam];
            z[beam] = range_m[beam] * direction[2][beam] + origin[2][beam];
        }
        if (group->miss_m2)
            place_near(group->axis_m + 3 * member, planes->range_m + which * width, direction,
                       width, x, y, z);
    }
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
            planes->x[element] = pose[0] * forward - pose[1] * right + pose[2] * up + pose[3];
            planes->y[element] = pose[4] * forward - pose[5] * right + pose[6] * up + pose[7];
            planes->z[element] = pose[8] * forward - pose[9] * right + pose[10] * up + pose[11];
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

/* Mirrored: a beam leaves at twice the angle of the rotor past the start of its mirror, whose
   cosine and sine are those of the column, and is corrected by tables over the rotor angle
   (docs/sources/hesai.md section 6). */
static void project_mirrored(const Group *group, int64_t encoder, int64_t table, int64_t column,
                             Planes *planes)
{
    const double revolution = 2 * 3.141592653589793;
    const int64_t width = group->width, cells = group->steps * group->beams;
    const float *plane = group->planes, *pose = group->pose;
    const float *firing_ns = group->firing_ns + table * width;
    const float speed = speed_of(encoder);
    const double steps_per_rad = (double)group->steps / revolution;
    const double angle = (double)(encoder & 0xFFFFFFFF) * (revolution / 4294967296.0);
    const double step = floor(angle * steps_per_rad);
    const float within = (float)(angle * steps_per_rad - step);
    for (int64_t beam = 0; beam < group->beams; beam++) {
        const float turned = speed * firing_ns[beam];
        /* While a column is fired, beams may enter the next or the previous cell. */
        float part = turned * (float)steps_per_rad + within;
        const float further = floorf(part);
        part -= further;
        int64_t cell = (((int64_t)further + (int64_t)step) * group->beams + beam) % cells;
        cell = cell < 0 ? cell + cells : cell;
        const float *own = plane + beam;
        const float azimuth_cosine = own[AZIMUTH_COSINE * width];
        const float azimuth_sine = own[AZIMUTH_SINE * width];
        const float past_cosine = group->cosine[column], past_sine = group->sine[column];
        float cosine = past_cosine * azimuth_cosine - past_sine * azimuth_sine;
        float sine = past_sine * azimuth_cosine + past_cosine * azimuth_sine;
        rotate(&cosine, &sine,
               group->azimuth_slope[cell] * part + group->azimuth_value[cell] + 2.0f * turned);
        float flat = own[ELEVATION_COSINE * width], up = own[ELEVATION_SINE * width];
        rotate(&flat, &up, group->elevation_slope[cell] * part + group->elevation_value[cell]);
        const float right = flat * sine, forward = flat * cosine;
        for (int64_t axis = 0; axis < 3; axis++) {
            float *out = axis == 0 ? planes->x : axis == 1 ? planes->y : planes->z;
            const float *row = pose + 4 * axis;
            const float towards = right * row[0] + row[1] * forward + row[2] * up;
            for (int64_t which = 0; which < group->returns; which++) {
                const int64_t element = which * width + beam;
                out[element] = planes->range_m[element] * towards + row[3];
            }
        }
    }
}

static inline double sine_of(const Group *group, int64_t angle_cdeg)
{
    return (double)group->sines[angle_cdeg % 36000];
}

/* Coordinates: the one point of a record, as integers; one return after the other. */
static void read_coordinates(const Group *group, int64_t member, const uint8_t *record,
                             Planes *planes)
{
    const double *pose = group->pose_f8 + 12 * member;
    memset(planes->range_m, 0, (size_t)(group->returns * group->width) * sizeof(float));
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
        planes->level[element] = (float)record[group->runs[0]];
        planes->x[element] = (float)(x * pose[0] + y * pose[1] + z * pose[2] + pose[3]);
        planes->y[element] = (float)(x * pose[4] + y * pose[5] + z * pose[6] + pose[7]);
        planes->z[element] = (float)(x * pose[8] + y * pose[9] + z * pose[10] + pose[11]);
    }
}

/* Placed: points that a driver computed, rotated and shifted. */
static void read_placed(const Group *group, int64_t member, const uint8_t *record, Planes *planes)
{
    const int64_t beams = group->beams;
    const uint8_t *from = record + group->runs[0];
    float *restrict x = planes->x;
    float *restrict y = planes->y;
    float *restrict z = planes->z;
    float *restrict range_m = planes->range_m;
    memcpy(x, from, (size_t)beams * 4);
    memcpy(y, from + 4 * beams, (size_t)beams * 4);
    memcpy(z, from + 8 * beams, (size_t)beams * 4);
    memcpy(planes->level, from + 12 * beams, (size_t)beams * 4);
    for (int64_t beam = beams; beam < group->width; beam++)
        x[beam] = y[beam] = z[beam] = 0;
    for (int64_t beam = 0; beam < group->width; beam++)
        range_m[beam] = x[beam] * x[beam] + y[beam] * y[beam] + z[beam] * z[beam];
    take_roots(range_m, group->width);
    const float *turn = group->direction + 9 * member, *shift_m = group->origin + 3 * member;
    for (int64_t beam = 0; beam < group->width; beam++) {
        const float before[] = {x[beam], y[beam], z[beam]};
        x[beam] = before[0] * turn[0] + before[1] * turn[1] + before[2] * turn[2] + shift_m[0];
        y[beam] = before[0] * turn[3] + before[1] * turn[4] + before[2] * turn[5] + shift_m[1];
        z[beam] = before[0] * turn[6] + before[1] * turn[7] + before[2] * turn[8] + shift_m[2];
    }
}

/* -- which slots become points ----------------------------------------------------------------- */

static int64_t count_kept(const uint8_t *keep, int64_t elements)
{
    int64_t total = 0;
    for (int64_t element = 0; element < elements; element++)
        total += keep[element];
    return total;
}

/* Mark the elements to keep; count those left after each step. */
static void mark(const Scan *scan, const Group *group, int64_t member, Planes *planes)
{
    const int64_t width = group->width, elements = group->returns * width;
    const float *restrict range_m = planes->range_m;
    uint8_t *restrict keep = planes->keep;
    int64_t *counts = group->counts + member * COUNTS;
    for (int64_t element = 0; element < elements; element++)
        keep[element] = range_m[element] > 0.0f;
    int64_t left = count_kept(keep, elements);
    counts[FOUND] += left;
    if (group->drops_repeated) {
        for (int64_t which = 1; which < group->returns; which++)
            for (int64_t earlier = 0; earlier < which; earlier++)
                for (int64_t beam = 0; beam < width; beam++)
                    keep[which * width + beam] &=
                        range_m[which * width + beam] != range_m[earlier * width + beam];
        left = count_kept(keep, elements);
    }
    counts[DISTINCT] += left;
    if (group->limits_m) {
        const float low = group->limits_m[2 * member], high = group->limits_m[2 * member + 1];
        for (int64_t element = 0; element < elements; element++)
            keep[element] &= (range_m[element] >= low) & (range_m[element] <= high);
        left = count_kept(keep, elements);
    }
    counts[IN_RANGE] += left;
    for (int64_t number = 0; number < scan->box_count; number++) {
        const float *box = scan->boxes_m + 6 * number;
        const float *restrict x = planes->x;
        const float *restrict y = planes->y;
        const float *restrict z = planes->z;
        for (int64_t element = 0; element < elements; element++) {
            const int inside = (x[element] >= box[0]) & (x[element] <= box[3])
                & (y[element] >= box[1]) & (y[element] <= box[4])
                & (z[element] >= box[2]) & (z[element] <= box[5]);
            keep[element] &= (uint8_t)!inside;
        }
    }
    if (scan->box_count)
        left = count_kept(keep, elements);
    counts[OUTSIDE_BOXES] += left;
}

/* Move the points of a column by a transform (3, 4). */
static void move_planes(const float *restrict moves, int64_t elements, Planes *planes)
{
    float *restrict x = planes->x;
    float *restrict y = planes->y;
    float *restrict z = planes->z;
    for (int64_t element = 0; element < elements; element++) {
        const float x_m = x[element], y_m = y[element], z_m = z[element];
        x[element] = x_m * moves[0] + y_m * moves[1] + z_m * moves[2] + moves[3];
        y[element] = x_m * moves[4] + y_m * moves[5] + z_m * moves[6] + moves[7];
        z[element] = x_m * moves[8] + y_m * moves[9] + z_m * moves[10] + moves[11];
    }
}

/* Labels of all elements; types of dual returns: docs/sources/outputs.md section 3. */
static void label(const Group *group, int64_t row, int64_t offset_ns, Planes *planes)
{
    enum { FIRST_STRONG = 3, SINGLE = 7, SUM_OF_TYPES = 9 };
    const int64_t width = group->width, elements = group->returns * width;
    const int64_t *restrict words = group->labels + row * elements;
    int64_t *restrict labels = planes->label;
    for (int64_t element = 0; element < elements; element++)
        labels[element] = words[element] + offset_ns;
    if (group->typed == NOT_TYPED)
        return;
    for (int64_t beam = 0; beam < width; beam++) {
        const float first_m = planes->range_m[beam], second_m = planes->range_m[width + beam];
        int64_t kind = FIRST_STRONG + (first_m > second_m);
        if (group->typed == TYPED_BY_LEVEL)
            kind += 2 * (planes->level[beam] < planes->level[width + beam]);
        int is_single = (first_m == 0.0f) | (second_m == 0.0f);
        if (group->sends_twice)
            is_single |= first_m == second_m;
        const int64_t single = is_single ? SINGLE : 0;
        labels[beam] |= (kind | single) << TYPE_BIT;
        labels[width + beam] |= ((SUM_OF_TYPES - kind) | single) << TYPE_BIT;
    }
}

/* -- rows -------------------------------------------------------------------------------------- */

static inline void put_point(float *point, const Planes *planes, int64_t element)
{
    point[0] = planes->x[element];
    point[1] = planes->y[element];
    point[2] = planes->z[element];
    point[3] = planes->level[element];
}

/* An organized row: arrays from its first slot; range_m and reflectivity may be NULL. */
typedef struct {
    float *point;
    int64_t *labels;
    float *range_m;
    uint16_t *reflectivity;
} Row;

/* Its number in the arrays of the scan. */
static int64_t organized_row(const Scan *scan, int64_t column)
{
    return scan->records ? column % scan->near_columns : scan->first_number + column;
}

static Row row_at(const Scan *scan, int64_t slot)
{
    return (Row){scan->point + 4 * slot, scan->label + slot,
                 scan->range_m ? scan->range_m + slot : 0,
                 scan->reflectivity ? scan->reflectivity + slot : 0};
}

/* Label of slots without a point, by that of any point of the column. */
static int64_t label_of_empty(int64_t label)
{
    return (int64_t)((uint64_t)label >> LIDAR_ID_BIT << LIDAR_ID_BIT);
}

enum { NAN_BITS = 0x7FC00000 };

/* Slots from `first` to `end` without a point; label: of empty slots. */
static void empty_slots(const Row *row, int64_t first, int64_t end, int64_t label)
{
    const uint32_t nan_bits = NAN_BITS;
    float nan;
    memcpy(&nan, &nan_bits, sizeof nan);
    for (int64_t value = 4 * first; value < 4 * end; value++)
        row->point[value] = nan;
    for (int64_t slot = first; slot < end; slot++)
        row->labels[slot] = label;
    for (int64_t slot = first; row->range_m && slot < end; slot++)
        row->range_m[slot] = nan;
    for (int64_t slot = first; row->reflectivity && slot < end; slot++)
        row->reflectivity[slot] = 0;
}

#if defined(__SSE2__)
/* Rows of lanes 1, 2, 3 after that of lane 0, by the bits of the lanes that are kept, and how many
   are. */
static const uint8_t NEXT[16][4] = {
    {0, 0, 0, 0}, {1, 1, 1, 1}, {0, 1, 1, 1}, {1, 2, 2, 2}, {0, 0, 1, 1}, {1, 1, 2, 2},
    {0, 1, 2, 2}, {1, 2, 3, 3}, {0, 0, 0, 1}, {1, 1, 1, 2}, {0, 1, 1, 2}, {1, 2, 2, 3},
    {0, 0, 1, 2}, {1, 1, 2, 3}, {0, 1, 2, 3}, {1, 2, 3, 4},
};

/* Store the points and labels of the lanes in `kept` to rows from `row`; others are overwritten by
   the next point. No branch depends on `kept`, which processors would often predict wrongly. p0 to
   p3: x, y, z, level of four beams. Return the next row. */
static inline int64_t store_kept(float *point, int64_t *labels, int64_t row, int kept, __m128 p0,
                                 __m128 p1, __m128 p2, __m128 p3, __m128i low, __m128i high)
{
    point += 4 * row;
    labels += row;
    _MM_TRANSPOSE4_PS(p0, p1, p2, p3);
    const uint8_t *next = NEXT[kept];
    const int64_t second = next[0], third = next[1], fourth = next[2];
    _mm_storeu_ps(point, p0);
    _mm_storeu_ps(point + 4 * second, p1);
    _mm_storeu_ps(point + 4 * third, p2);
    _mm_storeu_ps(point + 4 * fourth, p3);
    _mm_storel_epi64((__m128i *)labels, low);
    _mm_storeh_pi((__m64 *)(labels + second), _mm_castsi128_ps(low));
    _mm_storel_epi64((__m128i *)(labels + third), high);
    _mm_storeh_pi((__m64 *)(labels + fourth), _mm_castsi128_ps(high));
    return row + next[3];
}

/* 32 bits of ones for each lane in `kept`. */
static inline __m128i mask_of(int kept)
{
    const __m128i bits = _mm_set_epi32(8, 4, 2, 1);
    return _mm_cmpeq_epi32(_mm_and_si128(_mm_set1_epi32(kept), bits), bits);
}

/* The lanes of `mask`; others are NaN. */
static inline __m128 or_nan(__m128i mask, __m128 values)
{
    return _mm_castsi128_ps(_mm_or_si128(_mm_and_si128(mask, _mm_castps_si128(values)),
                                         _mm_andnot_si128(mask, _mm_set1_epi32(NAN_BITS))));
}

/* Store four beams to the slots from `slot`, as `store_kept`; those not in `mask` are empty. */
static inline void store_slots(float *point, int64_t *labels, int64_t slot, __m128i mask, __m128 p0,
                               __m128 p1, __m128 p2, __m128 p3, __m128i low, __m128i high,
                               __m128i empty)
{
    const __m128i first = _mm_unpacklo_epi32(mask, mask), last = _mm_unpackhi_epi32(mask, mask);
    p0 = or_nan(mask, p0);
    p1 = or_nan(mask, p1);
    p2 = or_nan(mask, p2);
    p3 = or_nan(mask, p3);
    _MM_TRANSPOSE4_PS(p0, p1, p2, p3);
    point += 4 * slot;
    _mm_storeu_ps(point, p0);
    _mm_storeu_ps(point + 4, p1);
    _mm_storeu_ps(point + 8, p2);
    _mm_storeu_ps(point + 12, p3);
    __m128i *words = (__m128i *)(labels + slot);
    _mm_storeu_si128(words, _mm_or_si128(_mm_and_si128(first, low), _mm_andnot_si128(first, empty)));
    _mm_storeu_si128(words + 1,
                     _mm_or_si128(_mm_and_si128(last, high), _mm_andnot_si128(last, empty)));
}
#endif

/* -- the usual case in one pass ----------------------------------------------------------------- */

#if defined(__SSE2__)
/* What the beams of a column have in common. Beams are done by fours, from pixels to rows. */
typedef struct {
    __m128i mask, level_mask, reflectivity_mask, silent, offsets;
    __m128i empty; /* label of empty slots */
    __m128i shift, level_shift, reflectivity_shift;
    __m128 factor, divisor, cosine, sine, speed;
    __m128 low_m, high_m;
    __m128 origin[3]; /* TABLED */
    __m128 moves[12];
    const float *direction, *origins, *reach, *firing_ns;
    const int64_t *words;
    /* Rows, of an organized scan those of the column. */
    float *point;
    int64_t *label;
    float *ranges_m;
    uint16_t *reflectivities;
    int64_t used, width, distance_byte, level_byte, reflectivity_byte;
    int level_word, is_big, is_filtered, is_limited, has_boxes, has_extras, has_moves, is_plain;
    int is_upright; /* TABLED: `UPRIGHT` fits */
} Column;

static inline __m128i load_four(const uint8_t *from, int64_t step)
{
    if (step == 4)
        return _mm_loadu_si128((const __m128i *)from);
    int32_t words[4];
    for (int lane = 0; lane < 4; lane++)
        memcpy(words + lane, from + lane * step, 4);
    return _mm_set_epi32(words[3], words[2], words[1], words[0]);
}

static inline __m128 multiply_add(__m128 a, __m128 b, __m128 c, __m128 d)
{
    return _mm_add_ps(_mm_mul_ps(a, b), _mm_mul_ps(c, d));
}

/* cos * V1 + sin * V2 + V3 of one axis, as `combine`. */
static inline __m128 combine_four(const float *vectors, int64_t width, int64_t used, __m128 cosine,
                                  __m128 sine)
{
    const __m128 third = _mm_loadu_ps(vectors + 6 * width);
    if (!(used & 1))
        return third;
    const __m128 turned = multiply_add(cosine, _mm_loadu_ps(vectors), sine,
                                       _mm_loadu_ps(vectors + 3 * width));
    return used >> 3 & 1 ? _mm_add_ps(turned, third) : turned;
}

/* used: bits of the vectors to add, as `Group.used`; a constant here. */
static inline void place_tabled(const Column *own, int64_t width, int64_t used, int64_t beam,
                                __m128 range_m, __m128 *xyz)
{
    const __m128 reached_m = _mm_add_ps(range_m, _mm_loadu_ps(own->reach + beam));
    for (int axis = 0; axis < 3; axis++) {
        const __m128 direction = combine_four(own->direction + axis * width + beam, width,
                                              used >> axis, own->cosine, own->sine);
        xyz[axis] = _mm_add_ps(_mm_mul_ps(reached_m, direction), own->origin[axis]);
    }
}

static inline void place_turning(const Column *own, int64_t width, int64_t beam, __m128 range_m,
                                 __m128 *xyz)
{
    __m128 cosine = own->cosine, sine = own->sine;
    if (own->firing_ns) {
        const __m128 turned = _mm_mul_ps(own->speed, _mm_loadu_ps(own->firing_ns + beam));
        const __m128 half = _mm_mul_ps(turned, _mm_set1_ps(0.5f));
        const __m128 before = cosine, across = sine;
        cosine = _mm_sub_ps(
            before, _mm_mul_ps(_mm_add_ps(_mm_mul_ps(half, before), across), turned));
        sine = _mm_add_ps(
            across, _mm_mul_ps(_mm_sub_ps(before, _mm_mul_ps(half, across)), turned));
    }
    if (own->reach)
        range_m = _mm_add_ps(range_m, _mm_loadu_ps(own->reach + beam));
    for (int axis = 0; axis < 3; axis++) {
        const float *directions = own->direction + axis * width + beam;
        const float *origins = own->origins + axis * width + beam;
        const __m128 direction =
            combine_four(directions, width, own->used >> axis, cosine, sine);
        const __m128 origin =
            combine_four(origins, width, own->used >> (6 + axis), cosine, sine);
        xyz[axis] = _mm_add_ps(_mm_mul_ps(range_m, direction), origin);
    }
}

/* Lanes of points outside of all boxes. */
static inline int outside_boxes(const Scan *scan, const __m128 *xyz)
{
    __m128 inside = _mm_setzero_ps();
    for (int64_t number = 0; number < scan->box_count; number++) {
        const float *box = scan->boxes_m + 6 * number;
        __m128 both = _mm_cmpeq_ps(_mm_setzero_ps(), _mm_setzero_ps());
        for (int axis = 0; axis < 3; axis++) {
            both = _mm_and_ps(both, _mm_cmpge_ps(xyz[axis], _mm_set1_ps(box[axis])));
            both = _mm_and_ps(both, _mm_cmple_ps(xyz[axis], _mm_set1_ps(box[axis + 3])));
        }
        inside = _mm_or_ps(inside, both);
    }
    return ~_mm_movemask_ps(inside) & 15;
}

/* As `move_planes`. */
static inline void move_four(const __m128 *moves, __m128 *xyz)
{
    const __m128 x = xyz[0], y = xyz[1], z = xyz[2];
    for (int axis = 0; axis < 3; axis++, moves += 4)
        xyz[axis] = _mm_add_ps(
            _mm_add_ps(multiply_add(x, moves[0], y, moves[1]), _mm_mul_ps(z, moves[2])), moves[3]);
}

/* Ranges and reflectivities of the lanes in `kept` to rows from `row`. */
static inline void store_extras(const Column *own, int64_t row, int kept, __m128 range_m,
                                __m128i reflectivity)
{
    float ranges_m[4];
    int32_t reflectivities[4];
    _mm_storeu_ps(ranges_m, range_m);
    _mm_storeu_si128((__m128i *)reflectivities, reflectivity);
    for (int lane = 0; lane < 4; lane++) {
        if (own->ranges_m)
            own->ranges_m[row] = ranges_m[lane];
        if (own->reflectivities)
            own->reflectivities[row] = (uint16_t)reflectivities[lane];
        row += kept >> lane & 1;
    }
}

/* The same to slots, as `store_slots`. */
static inline void store_slot_extras(const Column *own, int64_t slot, __m128i mask, __m128 range_m,
                                     __m128i reflectivity)
{
    /* To 16 bits: signed numbers are not limited when they are packed. */
    const __m128i wide = _mm_srai_epi32(_mm_slli_epi32(_mm_and_si128(mask, reflectivity), 16), 16);
    if (own->ranges_m)
        _mm_storeu_ps(own->ranges_m + slot, or_nan(mask, range_m));
    if (own->reflectivities)
        _mm_storel_epi64((__m128i *)(own->reflectivities + slot), _mm_packs_epi32(wide, wide));
}

static inline __m128i field_of(__m128i words, __m128i shift, __m128i mask)
{
    return _mm_and_si128(_mm_srl_epi32(words, shift), mask);
}

/* Four beams of a run: their pixels begin at `from`; with `is_read` their words are in `near` and
   `levels`. Return the next row. */
FOR_CONSTANTS int64_t decode_four(const Scan *scan, const Group *group, const Column *own,
                                  int64_t kind, int64_t step, int is_plain, int has_moves,
                                  int is_read, int is_organized, const uint8_t *from,
                                  const uint32_t *near, const uint32_t *levels, int64_t beam,
                                  int64_t row, int64_t *counts)
{
    /* The distance is in the first word, as fields are listed. */
    const __m128i first = is_read ? _mm_load_si128((const __m128i *)near)
                                  : load_four(from + own->distance_byte, step);
    __m128i value = _mm_srl_epi32(first, own->shift);
    if ((!is_plain || kind == TURNING) && own->is_big) {
        const __m128i byte = _mm_set1_epi32(0xFF);
        value = _mm_or_si128(_mm_slli_epi32(_mm_and_si128(value, byte), 8),
                             _mm_and_si128(_mm_srli_epi32(value, 8), byte));
    }
    value = _mm_and_si128(value, own->mask);
    const __m128i found = _mm_cmpgt_epi32(value, own->silent);
    int kept = _mm_movemask_ps(_mm_castsi128_ps(found));
    if (!kept && !is_organized)
        return row;
    const __m128 range_m = _mm_div_ps(
        _mm_mul_ps(_mm_cvtepi32_ps(_mm_and_si128(value, found)), own->factor), own->divisor);
    if (!is_plain && own->is_filtered)
        counts[FOUND] += NEXT[kept][3];
    if (!is_plain && own->is_limited) {
        kept &= _mm_movemask_ps(_mm_and_ps(_mm_cmpge_ps(range_m, own->low_m),
                                           _mm_cmple_ps(range_m, own->high_m)));
        if (!kept && !is_organized)
            return row;
    }
    if (!is_plain && own->has_boxes)
        counts[IN_RANGE] += NEXT[kept][3];
    __m128 xyz[3];
    if (kind == UPRIGHT)
        place_tabled(own, UPRIGHT_BEAMS, UPRIGHT_VECTORS, beam, range_m, xyz);
    else if (kind == TABLED)
        place_tabled(own, own->width, ALL_VECTORS, beam, range_m, xyz);
    else
        place_turning(own, own->width, beam, range_m, xyz);
    if (!is_plain && own->has_boxes)
        kept &= outside_boxes(scan, xyz);
    if (has_moves)
        move_four(own->moves, xyz);
    __m128i second = first;
    if (is_read)
        second = _mm_load_si128((const __m128i *)levels);
    else if (own->level_word)
        second = load_four(from + own->level_byte, step);
    const __m128i level = field_of(second, own->level_shift, own->level_mask);
    if (!is_plain && own->has_extras) {
        __m128i reflectivity = _mm_setzero_si128();
        if (group->has_reflectivity)
            reflectivity = field_of(load_four(from + own->reflectivity_byte, step),
                                    own->reflectivity_shift, own->reflectivity_mask);
        if (is_organized)
            store_slot_extras(own, beam, mask_of(kept), range_m, reflectivity);
        else
            store_extras(own, row, kept, range_m, reflectivity);
    }
    const __m128i *labels = (const __m128i *)(own->words + beam);
    const __m128i low = _mm_add_epi64(_mm_loadu_si128(labels), own->offsets);
    const __m128i high = _mm_add_epi64(_mm_loadu_si128(labels + 1), own->offsets);
    if (!is_organized)
        return store_kept(own->point, own->label, row, kept, xyz[0], xyz[1], xyz[2],
                          _mm_cvtepi32_ps(level), low, high);
    store_slots(own->point, own->label, beam, mask_of(kept), xyz[0], xyz[1], xyz[2],
                _mm_cvtepi32_ps(level), low, high, own->empty);
    return row + NEXT[kept][3];
}

/* Add the counts of a column; points: of it. */
static inline void add_counts(const Column *own, int64_t points, const int64_t *own_counts,
                              int64_t *counts)
{
    /* What no filter leaves out are points. */
    const int64_t found = own->is_filtered ? own_counts[FOUND] : points;
    counts[FOUND] += found;
    counts[DISTINCT] += found;
    counts[IN_RANGE] += own->has_boxes ? own_counts[IN_RANGE] : points;
    counts[OUTSIDE_BOXES] += points;
}

/* All runs of a column; with constant steps and kinds the compiler leaves out what is not used. */
FOR_CONSTANTS int64_t decode_runs(const Scan *scan, const Group *group, const Column *own,
                                  int64_t kind, int64_t step, int is_plain, int has_moves,
                                  int is_organized, const uint8_t *record, int64_t row,
                                  int64_t *counts)
{
    int64_t own_counts[COUNTS] = {0};
    const int64_t first_row = row;
    const int64_t *run = group->runs;
    for (int64_t number = 0; number < group->run_count; number++, run += 3) {
        const uint8_t *from = record + run[0];
        const int64_t beams = run[2], first_beam = run[1];
        _Alignas(64) uint32_t near[MOST_BEAMS], levels[MOST_BEAMS];
        if (kind != TURNING) {
            /* Reads the column as a whole, since the passes below would wait for each piece. */
            gather_every(from + own->distance_byte, step, beams, near);
            if (own->level_word)
                gather_every(from + own->level_byte, step, beams, levels);
        }
        for (int64_t beam = 0; beam < beams; beam += 4)
            row = decode_four(scan, group, own, kind, step, is_plain, has_moves, kind != TURNING,
                              is_organized, from + beam * step, near + beam,
                              (own->level_word ? levels : near) + beam, first_beam + beam, row,
                              own_counts);
    }
    add_counts(own, row - first_row, own_counts, counts);
    return row;
}

/* The same of a column whose beams come in another order than their pixels. */
FOR_CONSTANTS int64_t decode_places(const Scan *scan, const Group *group, const Column *own,
                                    int64_t kind, int is_plain, const uint8_t *record, int64_t row,
                                    int64_t *counts)
{
    int64_t own_counts[COUNTS] = {0};
    const int64_t first_row = row;
    _Alignas(64) uint32_t near[MOST_BEAMS], levels[MOST_BEAMS];
    /* cppcheck-suppress ctuuninitvar ; decode_fused() sets it, field by field */
    gather_at(record + own->distance_byte, group->places, group->slots, near);
    if (own->level_word)
        gather_at(record + own->level_byte, group->places, group->slots, levels);
    for (int64_t beam = 0; beam < group->slots; beam += 4)
        row = decode_four(scan, group, own, kind, 0, is_plain, own->has_moves, 1, 0, record,
                          near + beam, (own->level_word ? levels : near) + beam, beam, row,
                          own_counts);
    add_counts(own, row - first_row, own_counts, counts);
    return row;
}

/* What the beams of a column of a group that `fits_fours` have in common; known: row of its labels;
   slot: first one of its row in an organized scan, 0 in a dense one. */
static inline void set_column(const Scan *scan, const Group *group, int64_t member, int64_t column,
                       int64_t known, int64_t slot, Column *own)
{
    const int64_t width = group->width, encoder = scan->encoder[column];
    const Field *fields = group->fields;
    own->distance_byte = group->word_bytes[fields[DISTANCE].word];
    own->level_word = (int)fields[INTENSITY].word;
    own->level_byte = group->word_bytes[fields[INTENSITY].word];
    own->reflectivity_byte = group->word_bytes[fields[REFLECTIVITY].word];
    own->is_big = (int)fields[DISTANCE].is_big;
    own->mask = _mm_set1_epi32((int32_t)fields[DISTANCE].mask);
    own->level_mask = _mm_set1_epi32((int32_t)fields[INTENSITY].mask);
    own->reflectivity_mask = _mm_set1_epi32((int32_t)fields[REFLECTIVITY].mask);
    own->shift = _mm_cvtsi32_si128((int32_t)fields[DISTANCE].shift);
    own->level_shift = _mm_cvtsi32_si128((int32_t)fields[INTENSITY].shift);
    own->reflectivity_shift = _mm_cvtsi32_si128((int32_t)fields[REFLECTIVITY].shift);
    own->silent = _mm_set1_epi32((int32_t)group->silent);
    own->factor = _mm_set1_ps(group->scale[0]);
    own->divisor = _mm_set1_ps(group->scale[1]);
    own->offsets = _mm_set1_epi64x(scan->stamp_ns[column] - scan->start_ns);
    own->words = group->labels + known * width;
    own->direction = group->direction + member * 9 * width;
    own->reach = group->reach ? group->reach + member * width : 0;
    own->is_limited = group->limits_m != 0;
    own->low_m = _mm_set1_ps(own->is_limited ? group->limits_m[2 * member] : 0);
    own->high_m = _mm_set1_ps(own->is_limited ? group->limits_m[2 * member + 1] : 0);
    own->has_boxes = scan->box_count > 0;
    own->has_extras = scan->range_m || scan->reflectivity;
    own->point = scan->point + 4 * slot;
    own->label = scan->label + slot;
    own->ranges_m = scan->range_m ? scan->range_m + slot : 0;
    own->reflectivities = scan->reflectivity ? scan->reflectivity + slot : 0;
    own->empty = _mm_set1_epi64x(label_of_empty(own->words[0]));
    own->width = width;
    own->is_filtered = own->is_limited || own->has_boxes;
    own->has_moves = scan->moves != 0;
    for (int number = 0; own->has_moves && number < 12; number++)
        own->moves[number] = _mm_set1_ps(scan->moves[12 * column + number]);
    own->is_plain = !own->is_filtered && !own->has_extras;
    if (group->kind == TABLED) {
        const int64_t at = table_row(group, member, encoder);
        own->cosine = _mm_set1_ps(group->cosine[at]);
        own->sine = _mm_set1_ps(group->sine[at]);
        for (int axis = 0; axis < 3; axis++)
            own->origin[axis] = _mm_set1_ps(group->origin[3 * at + axis]);
        own->is_upright = width == UPRIGHT_BEAMS && !own->has_moves
            && group->used[member] == UPRIGHT_VECTORS;
        return;
    }
    own->cosine = _mm_set1_ps(group->cosine[column]);
    own->sine = _mm_set1_ps(group->sine[column]);
    own->origins = group->origin + member * 9 * width;
    own->used = group->used[member];
    const float speed = speed_of(encoder);
    own->speed = _mm_set1_ps(speed);
    own->firing_ns = group->firing_ns && speed != 0.0f ? group->firing_ns + known * width : 0;
}

/* A column of a dense scan. Return the next row. */
static int64_t decode_dense(const Scan *scan, const Group *group, int64_t member, int64_t column,
                            int64_t known, const uint8_t *record, int64_t row)
{
    Column own;
    set_column(scan, group, member, column, known, 0, &own);
    int64_t *counts = group->counts + member * COUNTS;
    const int has_moves = own.has_moves;
    if (group->kind == TABLED) {
        if (group->places)
            return decode_places(scan, group, &own, TABLED, 0, record, row, counts);
        const int is_short = !own.is_big && group->step == 4;
        const int is_long = !own.is_big && group->step == 12 && own.is_plain;
        if (is_short && own.is_plain && own.is_upright)
            return decode_runs(scan, group, &own, UPRIGHT, 4, 1, 0, 0, record, row, counts);
        if (is_short && own.is_upright)
            return decode_runs(scan, group, &own, UPRIGHT, 4, 0, 0, 0, record, row, counts);
        if (is_long && own.is_upright)
            return decode_runs(scan, group, &own, UPRIGHT, 12, 1, 0, 0, record, row, counts);
        if (is_short && own.is_plain && has_moves)
            return decode_runs(scan, group, &own, TABLED, 4, 1, 1, 0, record, row, counts);
        if (is_short && own.is_plain)
            return decode_runs(scan, group, &own, TABLED, 4, 1, 0, 0, record, row, counts);
        if (is_long && has_moves)
            return decode_runs(scan, group, &own, TABLED, 12, 1, 1, 0, record, row, counts);
        if (is_long)
            return decode_runs(scan, group, &own, TABLED, 12, 1, 0, 0, record, row, counts);
        return decode_runs(scan, group, &own, TABLED, group->step, 0, has_moves, 0, record, row,
                           counts);
    }
    if (group->places && own.is_plain)
        return decode_places(scan, group, &own, TURNING, 1, record, row, counts);
    if (group->places)
        return decode_places(scan, group, &own, TURNING, 0, record, row, counts);
    if (own.is_plain && group->step == 3 && has_moves)
        return decode_runs(scan, group, &own, TURNING, 3, 1, 1, 0, record, row, counts);
    if (own.is_plain && group->step == 3)
        return decode_runs(scan, group, &own, TURNING, 3, 1, 0, 0, record, row, counts);
    return decode_runs(scan, group, &own, TURNING, group->step, 0, has_moves, 0, record, row,
                       counts);
}

/* A column of an organized scan whose slots are beams. Return `row` and the number of points. */
static int64_t decode_slots(const Scan *scan, const Group *group, int64_t member, int64_t column,
                            int64_t known, const uint8_t *record, int64_t row)
{
    const int64_t slot = organized_row(scan, column) * mlbatch_row_step(scan);
    const Row rest = row_at(scan, slot);
    Column own;
    memset(&own, 0, sizeof own);
    set_column(scan, group, member, column, known, slot, &own);
    empty_slots(&rest, group->beams, scan->row_slots, label_of_empty(own.words[0]));
    int64_t *counts = group->counts + member * COUNTS;
    const int is_usual = !own.is_big && own.is_upright;
    if (is_usual && own.is_plain && group->step == 4)
        return decode_runs(scan, group, &own, UPRIGHT, 4, 1, 0, 1, record, row, counts);
    if (is_usual && group->step == 4)
        return decode_runs(scan, group, &own, UPRIGHT, 4, 0, 0, 1, record, row, counts);
    if (is_usual && own.is_plain && group->step == 12)
        return decode_runs(scan, group, &own, UPRIGHT, 12, 1, 0, 1, record, row, counts);
    if (group->kind == TABLED)
        return decode_runs(scan, group, &own, TABLED, group->step, 0, own.has_moves, 1, record,
                           row, counts);
    return decode_runs(scan, group, &own, TURNING, group->step, 0, own.has_moves, 1, record, row,
                       counts);
}
#endif

#if defined(__SSE2__)
static inline __m128 turn_four(const __m128 *row, __m128 x, __m128 y, __m128 z)
{
    const __m128 sum = _mm_add_ps(_mm_mul_ps(x, row[0]), _mm_mul_ps(y, row[1]));
    return _mm_add_ps(_mm_add_ps(sum, _mm_mul_ps(z, row[2])), row[3]);
}

/* Points that a driver computed, from their planes to rows of a dense scan, four at a time: the
   operations of `read_placed`, `mark`, `move_planes`, `label` and `emit_fours`. For `fits_places`.
   Return the next row. */
static int64_t decode_placed(const Scan *scan, const Group *group, int64_t member, int64_t column,
                             int64_t known, const uint8_t *record, int64_t row)
{
    enum { ROWS = 3, STEP = 4 };
    const int64_t beams = group->beams;
    const float *planes = (const float *)(const void *)(record + group->runs[0]);
    const float *turn = group->direction + 9 * member, *shift_m = group->origin + 3 * member;
    const float *moves = scan->moves ? scan->moves + 12 * column : 0;
    __m128 turns[ROWS][STEP], moved[ROWS][STEP];
    for (int axis = 0; axis < ROWS; axis++)
        for (int step = 0; step < STEP; step++) {
            turns[axis][step] = _mm_set1_ps(step < ROWS ? turn[ROWS * axis + step]
                                                        : shift_m[axis]);
            moved[axis][step] = _mm_set1_ps(moves ? moves[STEP * axis + step] : 0.0f);
        }
    const float *limits_m = group->limits_m ? group->limits_m + 2 * member : 0;
    const __m128 low_m = _mm_set1_ps(limits_m ? limits_m[0] : 0.0f);
    const __m128 high_m = _mm_set1_ps(limits_m ? limits_m[1] : 0.0f);
    const __m128i offset_ns = _mm_set1_epi64x(scan->stamp_ns[column] - scan->start_ns);
    const int64_t *words = group->labels + known * group->width;
    const int64_t first_row = row;
    int64_t found = 0;
    for (int64_t beam = 0; beam < beams; beam += 4) {
        const __m128 x = _mm_loadu_ps(planes + beam);
        const __m128 y = _mm_loadu_ps(planes + beams + beam);
        const __m128 z = _mm_loadu_ps(planes + 2 * beams + beam);
        const __m128 range_m = _mm_sqrt_ps(_mm_add_ps(
            _mm_add_ps(_mm_mul_ps(x, x), _mm_mul_ps(y, y)), _mm_mul_ps(z, z)));
        __m128 keep = _mm_cmpgt_ps(range_m, _mm_setzero_ps());
        found += NEXT[_mm_movemask_ps(keep)][3];
        if (limits_m)
            keep = _mm_and_ps(keep, _mm_and_ps(_mm_cmpge_ps(range_m, low_m),
                                               _mm_cmple_ps(range_m, high_m)));
        const int kept = _mm_movemask_ps(keep);
        if (!kept)
            continue;
        __m128 body[ROWS];
        for (int axis = 0; axis < ROWS; axis++)
            body[axis] = turn_four(turns[axis], x, y, z);
        if (moves) {
            const __m128 before[] = {body[0], body[1], body[2]};
            for (int axis = 0; axis < ROWS; axis++)
                body[axis] = turn_four(moved[axis], before[0], before[1], before[2]);
        }
        const __m128i *own = (const __m128i *)(words + beam);
        row = store_kept(scan->point, scan->label, row, kept, body[0], body[1], body[2],
                         _mm_loadu_ps(planes + 3 * beams + beam),
                         _mm_add_epi64(_mm_loadu_si128(own), offset_ns),
                         _mm_add_epi64(_mm_loadu_si128(own + 1), offset_ns));
    }
    int64_t *counts = group->counts + member * COUNTS;
    counts[FOUND] += found;
    counts[DISTINCT] += found;
    counts[IN_RANGE] += row - first_row;
    counts[OUTSIDE_BOXES] += row - first_row;
    return row;
}

/* Whether `decode_placed` does all that a scan asks for. */
static int fits_places(const Scan *scan, const Group *group)
{
    return group->kind == PLACED && group->beams % 4 == 0 && group->slots == group->beams
        && group->typed == NOT_TYPED && !group->order && !scan->row_slots && !scan->box_count
        && !scan->range_m && !scan->reflectivity;
}

/* Kept elements in their order, four at a time; the slots are a multiple of four. */
static int64_t emit_fours(const Scan *scan, const Group *group, int64_t row, const Planes *planes)
{
    for (int64_t beam = 0; beam < group->slots; beam += 4) {
        uint32_t marks;
        memcpy(&marks, planes->keep + beam, 4);
        /* One bit a byte: 1, 0x100, 0x10000, 0x1000000. */
        const int kept = (int)((marks | marks >> 7 | marks >> 14 | marks >> 21) & 15);
        if (!kept)
            continue;
        const __m128i *labels = (const __m128i *)(planes->label + beam);
        row = store_kept(scan->point, scan->label, row, kept, _mm_load_ps(planes->x + beam),
                         _mm_load_ps(planes->y + beam), _mm_load_ps(planes->z + beam),
                         _mm_load_ps(planes->level + beam), _mm_load_si128(labels),
                         _mm_load_si128(labels + 1));
    }
    return row;
}
#endif

/* Kept elements in order of output. Returns the next row. */
static int64_t emit_ordered(const Scan *scan, const Group *group, const int64_t *order,
                            int64_t first_row, const Planes *planes)
{
    int64_t row = first_row;
    for (int64_t number = 0; number < group->slots; number++) {
        const int64_t element = order ? order[number] : number;
        put_point(scan->point + 4 * row, planes, element);
        scan->label[row] = planes->label[element];
        row += planes->keep[element];
    }
    return row;
}

/* Ranges and reflectivities of the kept elements, in order of output. */
static void emit_extras(const Scan *scan, const Group *group, const int64_t *order,
                        int64_t first_row, const Planes *planes)
{
    int64_t row = first_row;
    for (int64_t number = 0; scan->range_m && number < group->slots; number++) {
        const int64_t element = order ? order[number] : number;
        scan->range_m[row] = planes->range_m[element];
        row += planes->keep[element];
    }
    row = first_row;
    for (int64_t number = 0; scan->reflectivity && number < group->slots; number++) {
        const int64_t element = order ? order[number] : number;
        scan->reflectivity[row] = planes->reflectivity[element];
        row += planes->keep[element];
    }
}

/* The row of a column in an organized scan: every kept element to its slot, the others empty. */
static int64_t emit_organized(const Scan *scan, const Group *group, int64_t column,
                              const Planes *planes)
{
    const int64_t width = group->width;
    const Row row = row_at(scan, organized_row(scan, column) * mlbatch_row_step(scan));
    empty_slots(&row, 0, scan->row_slots, label_of_empty(planes->label[0]));
    int64_t count = 0;
    for (int64_t which = 0; which < group->returns; which++)
        for (int64_t element = which * width; element < which * width + group->beams; element++)
            if (planes->keep[element]) {
                const int64_t slot = group->slot ? group->slot[element] : element;
                put_point(row.point + 4 * slot, planes, element);
                row.labels[slot] = planes->label[element];
                if (row.range_m)
                    row.range_m[slot] = planes->range_m[element];
                if (row.reflectivity)
                    row.reflectivity[slot] = planes->reflectivity[element];
                count++;
            }
    return count;
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

static inline void prefetch(const void *from, int64_t bytes)
{
#if defined(__SSE2__)
    for (int64_t byte = 0; byte < bytes; byte += 64)
        _mm_prefetch((const char *)from + byte, _MM_HINT_T0);
#else
    (void)from;
    (void)bytes;
#endif
}

/* Ask for what a later column needs: neighbours in a scan are far apart in memory. */
static void prefetch_column(const Scan *scan, int64_t column)
{
    if (column >= scan->columns)
        return;
    const int64_t number = scan->group_of[scan->sensor[column]];
    if (number < 0)
        return;
    const Group *group = scan->groups + number;
    prefetch(record_of(scan, group, column), group->step * group->beams);
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
#if defined(__SSE2__)
    if (group->fits_fours && !scan->row_slots)
        return decode_dense(scan, group, member, column, known, record, row);
    if (group->fits_fours && scan->row_slots && !group->slot)
        return decode_slots(scan, group, member, column, known, record, row);
    if (fits_places(scan, group))
        return decode_placed(scan, group, member, column, known, record, row);
#endif
    const int has_pixels = group->kind != PLACED && group->kind != COORDINATES;
    for (int64_t which = 0; which < group->returns && has_pixels; which++)
        read_return(group, record, which, planes);
    switch (group->kind) {
    case PLACED: read_placed(group, member, record, planes); break;
    case COORDINATES: read_coordinates(group, member, record, planes); break;
    case CORRECTED: project_corrected(group, encoder, known, column, planes); break;
    case MIRRORED: project_mirrored(group, encoder, known, column, planes); break;
    case TABLED: project_tabled(group, member, encoder, planes); break;
    default: project_turning(group, member, encoder, known, column, planes);
    }
    mark(scan, group, member, planes);
    if (scan->moves)
        move_planes(scan->moves + 12 * column, group->returns * group->width, planes);
    label(group, known, offset_ns, planes);
    if (scan->row_slots)
        return row + emit_organized(scan, group, column, planes);
    const int64_t *order = group->order ? group->order + table * group->order_step : 0;
    emit_extras(scan, group, order, row, planes);
#if defined(__SSE2__)
    if (group->kind == PLACED && group->slots % 4 == 0)
        return emit_fours(scan, group, row, planes);
#endif
    return emit_ordered(scan, group, order, row, planes);
}

/* -- packed records ----------------------------------------------------------------------------- */

/* Decode a column of a dense scan to packed records. Return the next row. */
static int64_t pack_column(const Scan *scan, const Group *group, int64_t member, int64_t column,
                           int64_t row, Planes *planes)
{
    const Rows rows = {scan->point, scan->label, scan->range_m, scan->reflectivity, 1};
    const int64_t count = decode_column(scan, group, member, column,
                                        record_of(scan, group, column), 0, planes);
    mlbatch_pack(scan, &rows, count, scan->records + row * scan->record_bytes);
    return row + count;
}

/* Decode all columns of a scan, in their order; return the row after the last point (organized:
   the number of points). Sensors of no group are skipped. */
EXPORT int64_t mlbatch_decode(const Scan *scan)
{
    enum { AHEAD = 2 };
    Planes planes;
    memset(planes.words, 0, sizeof planes.words);
    memset(planes.reflectivity, 0, sizeof planes.reflectivity);
    int64_t row = scan->first_row, last_group = -1;
    for (int64_t column = 0; column < scan->columns; column++) {
        prefetch_column(scan, column + AHEAD);
        const int64_t sensor = scan->sensor[column];
        const int64_t number = scan->group_of[sensor];
        if (number < 0)
            continue;
        const Group *group = scan->groups + number;
        const int64_t first = row;
        if (number != last_group && last_group >= 0) {
            /* What another group left in beams that this one does not have. */
            memset(planes.words, 0, sizeof planes.words);
            memset(planes.reflectivity, 0, sizeof planes.reflectivity);
        }
        last_group = number;
        if (scan->records && !scan->row_slots)
            row = pack_column(scan, group, scan->member_of[sensor], column, row, &planes);
        else
            row = decode_column(scan, group, scan->member_of[sensor], column,
                                record_of(scan, group, column), row, &planes);
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
