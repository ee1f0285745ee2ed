/* Headers of packets to columns: `decode/native_headers.py`.

   All functions read packets that are as they usually are, and stop at any other: the caller then
   reads all packets of the batch with numpy. The results are the same. They keep no state. */
#include <string.h>

#include "native.h"

#if defined(__SSE2__)
#include <emmintrin.h>
#define PREFETCH(from) _mm_prefetch((const char *)(from), _MM_HINT_T0)
#else
#define PREFETCH(from) ((void)(from))
#endif

enum { AHEAD = 2 };

/* Little-endian number of up to 8 bytes. */
static inline int64_t number_at(const uint8_t *from, int64_t bytes)
{
    uint64_t value = 0;
    for (int64_t byte = 0; byte < bytes; byte++)
        value |= (uint64_t)from[byte] << 8 * byte;
    return (int64_t)value;
}

static inline int64_t short_at(const uint8_t *from)
{
    return from[0] | from[1] << 8;
}

static int has_values(const uint8_t *packet, int64_t count, const Check *checks)
{
    for (const Check *check = checks; check < checks + count; check++)
        if (number_at(packet + check->first, check->bytes) != check->value)
            return 0;
    return 1;
}

static inline int64_t floor_divide(int64_t value, int64_t divisor)
{
    return value / divisor - (value % divisor < 0);
}

/* -- a timestamp and a position in each column -------------------------------------------------- */

/* Columns of one packet; 0 unless all are valid and in order. newest: stamp before them. */
static int read_stamped(const StampedLayout *layout, const uint8_t *column, int64_t newest,
                        int64_t *stamp_ns, int64_t *encoder)
{
    const int64_t frame = layout->has_frames ? short_at(column + layout->frame_at) : 0;
    const int64_t block = short_at(column + layout->position_at) / layout->columns;
    for (int64_t number = 0; number < layout->columns; number++) {
        int64_t stamp;
        memcpy(&stamp, column, sizeof stamp);
        const int64_t position = short_at(column + layout->position_at);
        int is_usual = (column[layout->status_at] & 1) & (position < layout->positions);
        is_usual &= stamp >= newest;
        if (layout->has_frames)
            is_usual &= (short_at(column + layout->frame_at) == frame)
                & (position / layout->columns == block);
        if (!is_usual)
            return 0;
        newest = stamp;
        stamp_ns[number] = stamp;
        encoder[number] = position;
        column += layout->column_bytes;
    }
    return 1;
}

/* Packets whose columns have timestamps and positions. key: as `Lidar.sequence`; stamp_ns, encoder:
   (packets, columns). Return the number of packets before the first unusual one. */
EXPORT int64_t mlbatch_stamped(const StampedLayout *layout, const uint8_t *data, int64_t packets,
                               const int64_t *start, int64_t *key, int64_t *stamp_ns,
                               int64_t *encoder)
{
    const int64_t columns = layout->columns;
    int64_t newest = INT64_MIN;
    for (int64_t packet = 0; packet < packets; packet++) {
        const uint8_t *from = data + start[packet];
        if (packet + AHEAD < packets)
            for (int64_t column = 0; column < columns; column++)
                PREFETCH(data + start[packet + AHEAD] + layout->first_column
                         + column * layout->column_bytes);
        if (!has_values(from, layout->check_count, layout->checks)
            || !read_stamped(layout, from + layout->first_column, newest, stamp_ns, encoder))
            return packet;
        const int64_t rank = layout->rank[encoder[0] / columns];
        if (rank < 0)
            return packet;
        const int64_t frame_at =
            layout->has_frames ? layout->first_column + layout->frame_at : layout->frame_at;
        const int64_t frame = number_at(from + frame_at, layout->frame_bytes) % layout->frames;
        key[packet] = frame * layout->packets_per_frame + rank;
        newest = stamp_ns[columns - 1];
        stamp_ns += columns;
        encoder += columns;
    }
    return packets;
}

/* -- a timestamp in each packet, an azimuth in each block --------------------------------------- */

/* To the nearest integer, halves to the even one; below 2**51. */
static inline double nearest(double value)
{
    const double large = 0x1.8p52;
    return value + large - large;
}

static inline double floor_of(double value)
{
    const double whole = (double)(int64_t)value;
    return whole > value ? whole - 1 : whole;
}

/* Azimuths of the blocks, and the mean step between them; 0 if a block is not as usual. */
static int read_azimuths(const PacedLayout *layout, const uint8_t *packet, int64_t *azimuth,
                         double *step)
{
    for (int64_t block = 0; block < layout->block_count; block++) {
        const uint8_t *from = packet + block * layout->block_bytes;
        if (short_at(from) != layout->flags[block] || short_at(from + 2) > layout->circle)
            return 0;
    }
    int64_t total = 0;
    for (int64_t group = 0; group < layout->groups; group++) {
        const int64_t found =
            short_at(packet + group * layout->blocks_per_group * layout->block_bytes + 2);
        azimuth[group] = found == layout->circle ? 0 : found;
        if (!group)
            continue;
        /* Modulo the circle, but steps back of less than `widest`; wider steps span a gap. */
        int64_t turned = azimuth[group] - azimuth[group - 1];
        turned += turned < -layout->widest ? layout->circle : 0;
        turned -= turned >= layout->circle - layout->widest ? layout->circle : 0;
        if (turned > layout->widest)
            return 0;
        total += turned;
    }
    *step = layout->groups > 1 ? (double)total / (double)(layout->groups - 1) : 0;
    return 1;
}

/* Timestamps and rotor words of the columns of one packet. */
static void read_paced(const PacedLayout *layout, const int64_t *azimuth, double speed,
                       int64_t packet_ns, int64_t *stamp_ns, int64_t *encoder)
{
    /* A rotor word: `lidar/geometry.py`. */
    enum { ANGLE_BITS = 32, SPEED_BITS = 24 };
    const double limit = (double)((INT64_C(1) << (SPEED_BITS - 1)) - 1);
    const double per_s = layout->follows_rotor ? speed * layout->per_s : 0.0;
    double steps = nearest(per_s * layout->steps_per_hz);
    steps = steps < -limit ? -limit : steps > limit ? limit : steps;
    const int64_t field = (int64_t)steps & ((INT64_C(1) << SPEED_BITS) - 1);
    const int64_t halves = layout->columns / layout->groups;
    for (int64_t group = 0; group < layout->groups; group++)
        for (int64_t half = 0; half < halves; half++) {
            const int64_t column = group * halves + half;
            const double ahead = speed * layout->ahead_ns[column];
            const double turns = ((double)azimuth[group] + ahead) / (double)layout->circle;
            const double ticks =
                nearest((turns - floor_of(turns)) * (double)(INT64_C(1) << ANGLE_BITS));
            const int64_t angle = (int64_t)ticks & ((INT64_C(1) << ANGLE_BITS) - 1);
            encoder[column] = angle | (int64_t)((uint64_t)field << ANGLE_BITS);
            stamp_ns[column] = packet_ns + layout->start_ns[column];
        }
}

/* Packets with a timestamp within the hour and an azimuth in each block; as `mlbatch_stamped`. */
EXPORT int64_t mlbatch_paced(const PacedLayout *layout, const uint8_t *data, int64_t packets,
                             const int64_t *start, const int64_t *host_ns, int64_t *key,
                             int64_t *stamp_ns, int64_t *encoder)
{
    enum { MOST_GROUPS = 16, NS_PER_US = 1000 };
    const int64_t columns = layout->columns, hour = layout->period_ns;
    int64_t newest = INT64_MIN;
    for (int64_t packet = 0; packet < packets; packet++) {
        const uint8_t *from = data + start[packet];
        int64_t azimuth[MOST_GROUPS];
        double step;
        const int64_t part_ns = number_at(from + layout->stamp_at, 4) * NS_PER_US;
        if (part_ns >= hour || (layout->modes && !layout->modes[from[layout->mode_at]])
            || !read_azimuths(layout, from, azimuth, &step))
            return packet;
        const int64_t near_ns = host_ns[packet] + layout->offset_ns;
        const int64_t packet_ns = part_ns + floor_divide(near_ns - part_ns + hour / 2, hour) * hour;
        const double speed = layout->groups > 1 ? step / layout->group_ns : layout->known_speed;
        read_paced(layout, azimuth, speed, packet_ns, stamp_ns, encoder);
        for (int64_t column = 0; column < columns; column++) {
            if (stamp_ns[column] < newest)
                return packet;
            newest = stamp_ns[column];
        }
        key[packet] = mlbatch_content_key(from, layout->packet_bytes, layout->odd);
        stamp_ns += columns;
        encoder += columns;
    }
    return packets;
}

/* -- a packet is a column ----------------------------------------------------------------------- */

/* Packets of one column, which begin with the 8 bytes `first_word` and have a timestamp of 8 bytes,
   ns. key: as `content_keys`; stamp_ns: (packets,). Return the number of packets before the first
   unusual one. odd: NULL: keys are known. */
EXPORT int64_t mlbatch_single(const uint8_t *data, int64_t packets, const int64_t *start,
                              int64_t packet_bytes, int64_t first_word, int64_t stamp_at,
                              const uint64_t *odd, int64_t *key, int64_t *stamp_ns)
{
    int64_t newest = INT64_MIN;
    for (int64_t packet = 0; packet < packets; packet++) {
        const uint8_t *from = data + start[packet];
        int64_t word;
        memcpy(&word, from, sizeof word);
        memcpy(stamp_ns + packet, from + stamp_at, sizeof *stamp_ns);
        if (word != first_word || stamp_ns[packet] < newest)
            return packet;
        newest = stamp_ns[packet];
        if (odd)
            key[packet] = mlbatch_content_key(from, packet_bytes, odd);
    }
    return packets;
}
