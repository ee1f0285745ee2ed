/* Interface of the compiled library: plain C11 functions, called through ctypes.

   `library.py` takes structs and functions from this file, and `decode/groups.py` fills them by
   name: a member or an argument is `type name`, `type *name` or `type name[4]`. Arrays are
   C-contiguous and belong to the caller; no function allocates, keeps a pointer, or checks what
   its caller guarantees.
   Floating point: float32 operations in a fixed order, no contraction, so that every compiler and
   processor gives the same bytes. */
#ifndef MLBATCH_NATIVE_H
#define MLBATCH_NATIVE_H

#include <stdint.h>
#include <string.h>

#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "the compiled library reads little-endian words"
#endif

/* To be changed with every change of a struct or of a signature. */
#define MLBATCH_ABI 18

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

/* Functions that are compiled once for each set of constant arguments. */
#if defined(__GNUC__)
#define FOR_CONSTANTS static inline __attribute__((always_inline))
#else
#define FOR_CONSTANTS static inline
#endif

/* Whether `decode_wide.c` is compiled, the loops for AVX2; MLBATCH_NARROW: tests do without. */
#if defined(__x86_64__) && !defined(MLBATCH_NARROW)
#define MLBATCH_WIDE
#endif

/* Limits of the scratch arrays. */
#define MOST_BEAMS 256
#define MOST_RETURNS 3
#define MOST_WORDS 3

/* Slots behind each row of the scratch arrays of an organized scan that is packed. */
#define SPARE_SLOTS 4

/* Where the columns of a sensor are: `lidar/interface.py`, Records, in the ring of its packets. */
typedef struct {
    const uint8_t *first; /* column 0 of row 0 */
    int64_t rows;
    int64_t per_row;
    int64_t row_bytes;
    int64_t column_bytes;
    int64_t base; /* number of a row that was at `first` */
} Ring;

/* An integer in a word of a pixel: `(word >> shift) & mask`, its two bytes swapped if is_big. */
typedef struct {
    int64_t word;
    int64_t shift;
    int64_t mask;
    int64_t is_big;
} Field;

enum { DISTANCE, INTENSITY, REFLECTIVITY, FIELDS };

enum { TABLED, TURNING, PLACED, CORRECTED, MIRRORED, COORDINATES };

/* Integers of COORDINATES. */
enum { INT32_MM, INT16_CM, SPHERICAL_MM };

enum { NOT_TYPED, TYPED_BY_ORDER, TYPED_BY_LEVEL };

/* Planes of CORRECTED, one value per beam: cosine and sine of the angle on the rotor and above it,
   offsets, and three ranges: correction far, and value at 0 m and slope aside and ahead. */
enum {
    TURN_COSINE,
    TURN_SINE,
    FLAT,
    UP,
    ASIDE_M,
    ABOVE_M,
    FAR_M,
    RIGHT_M,
    RIGHT_SLOPE,
    FORWARD_M,
    FORWARD_SLOPE,
    CORRECTIONS
};

/* Planes of MIRRORED: cosine and sine of azimuth and elevation. */
enum { AZIMUTH_COSINE, AZIMUTH_SINE, ELEVATION_COSINE, ELEVATION_SINE, MIRRORS };

/* Slots of a member that are left after each step, and its columns. */
enum { COLUMNS, FOUND, DISTINCT, IN_RANGE, OUTSIDE_BOXES, COUNTS };

/* Sensors that are decoded alike (the members). E: elements, returns * width; T: firing tables. */
typedef struct {
    int64_t kind;
    int64_t beams;
    int64_t width; /* beams, rounded up to a multiple of 16 */
    int64_t returns;
    /* Pixels: step bytes apart, in runs of channels; words of 4 bytes are read from them. */
    int64_t step;
    int64_t run_count;
    const int64_t *runs; /* (returns, run_count, 3): first byte, first channel, channels */
    int64_t word_count;
    const int64_t *word_bytes; /* (returns, word_count): first bytes in a pixel */
    const Field *fields;       /* (returns, FIELDS) */
    const float *scale;        /* (2,): factor, divisor */
    int64_t silent;            /* distances up to this one are no return */
    int64_t dark_count;
    const int64_t *dark; /* (dark_count,): channels without returns */
    int64_t has_reflectivity;
    Ring *rings; /* (members,) */
    /* Vectors of the directions, (members, 3 vectors, 3 axes, width).
       TABLED: cosine and sine (rows,), origin (rows, 3), first_row (members,).
       TURNING: cosine and sine (columns of the scan,); origin as direction.
       used (members,): bits of the axes in which vectors 1 and 2 (from bit 0) and vector 3 (from
       bit 3) of the direction are not zero; TURNING: from bit 6 the same of the origin; TABLED: as
       if no vector were zero where the sign of a zero coordinate depends on all of them.
       PLACED: pixels are planes of float32 from the byte of the first run: x, y, z, intensity;
       from the byte that is the second number of the run, unless 0, a label of each point without
       its sensor, its time after the column; direction (members, 3, 3): rotation; origin
       (members, 3): translation, m. */
    const float *direction;
    const float *origin;
    const int64_t *first_row;
    int64_t rows;
    const int64_t *used;
    const float *reach;     /* (members, width) or NULL: added to ranges */
    const float *firing_ns; /* (members * T, width) or NULL */
    int64_t tables;         /* T */
    const float *cosine;
    const float *sine;
    /* TURNING whose ranges count from the axis, not from the optical centre: squares of the
       distances at which beams pass the axis (members, width), m2; NULL: others. Axis: origins of
       near points (members, 3); PLACED: origins of ranges, as points are recorded; NULL: zeros. */
    const float *miss_m2;
    const float *axis_m;
    /* CORRECTED: planes of CORRECTIONS (width,); MIRRORED: planes of MIRRORS (width,). One member,
       whose pose is (3, 4), row by row. */
    const float *planes;
    const float *pose;
    /* MIRRORED: corrections over the rotor angle, (steps, beams): value and slope. */
    const float *azimuth_value;
    const float *azimuth_slope;
    const float *elevation_value;
    const float *elevation_slope;
    int64_t steps;
    /* COORDINATES: integers of one point in a record; pose (members, 3, 4); sines of whole
       hundredths of a degree (36000,). */
    int64_t coordinates;
    const double *pose_f8;
    const float *sines;
    /* Slots. */
    int64_t slots;
    const int64_t *labels; /* (members * T, E): words of 8 bytes, time 0 */
    const int64_t *order;  /* (T, slots) or NULL: elements in order of output */
    int64_t order_step;    /* from table to table; 0: one for all */
    const int64_t *slot;   /* (E,): slot in an organized row; NULL: the beam */
    int64_t typed;
    int64_t sends_twice;
    int64_t drops_repeated;
    const float *limits_m; /* (members, 2) or NULL */
    int64_t *counts;       /* (members, COUNTS), added to */
} Group;

/* Kinds of `Piece`: bytes of the arrays of a scan, and values computed from them, as in
   `types.RecordKind`. */
enum {
    COPY_POINT,
    COPY_LABEL,
    COPY_REFLECTIVITY,
    SECONDS_F4,
    SECONDS_F8,
    RING_I4,
    RANGE_MM_U4,
    STAMP_F8,
    RING_F4,
    LIDAR_F4,
    LAS
};

/* A piece of a packed record; source and bytes: of a copy, from a row of its array. */
typedef struct {
    int64_t kind;
    int64_t offset;
    int64_t source;
    int64_t bytes;
} Piece;

/* What a header of LAS says of all points: extremes of x, y, z, m, and intensity; second returns. */
typedef struct {
    float low[4];
    float high[4];
    int64_t second;
} Totals;

/* A scan under construction. */
typedef struct {
    int64_t columns;
    const int64_t *stamp_ns; /* (columns,) */
    const int64_t *sensor;
    const int64_t *ring_index;
    const int64_t *encoder;
    int64_t start_ns;
    int64_t first_number; /* number of column 0 in the scan */
    int64_t first_row;    /* row of the first point */
    const int64_t *group_of;  /* (sensors,): -1 for sensors that are skipped */
    const int64_t *member_of; /* (sensors,) */
    int64_t group_count;
    const Group *groups;
    int64_t box_count;
    const float *boxes_m; /* (box_count, 6) */
    int64_t row_slots;    /* organized: slots of a row; 0: dense */
    const float *moves;   /* (columns, 3, 4) or NULL: moves points after all filters, m */
    /* Outputs, as in `decode/scan_buffer.py`; NULL: none. A dense scan has room for all
       slots of its columns. With `records` the arrays are scratch for `near_columns` columns. */
    float *point;
    int64_t *label;
    float *range_m;
    uint16_t *reflectivity;
    uint32_t *column;
    /* Packed records of `record_bytes`, in the order of the output: dense as the points, organized
       (row_slots, columns). NULL: none. */
    uint8_t *records;
    int64_t record_bytes;
    int64_t piece_count;
    const Piece *pieces;
    int64_t near_columns;
    int64_t stamp_start_ns; /* start_ns on the clock of STAMP_F8 */
    Totals *totals;         /* of LAS, added to */
} Scan;

/* Values of points to be packed, as the arrays of a scan; step: rows from one to the next. */
typedef struct {
    const float *point;
    const int64_t *label;
    const float *range_m;
    const uint16_t *reflectivity;
    int64_t step;
} Rows;

/* `mlbatch_decode` by wider vectors; `decode_wide.c`. */
int64_t mlbatch_decode_wide(const Scan *scan);

/* Pack so many points to records; `pack.c`. */
EXPORT void mlbatch_pack(const Scan *scan, const Rows *rows, int64_t count, uint8_t *record);

/* Pack the rows of columns [begin, end) of an organized scan, which are in the scratch arrays. */
void mlbatch_pack_rows(const Scan *scan, int64_t begin, int64_t end);

/* Slots from one row of an organized scan to the next: rows in scratch arrays have spare slots,
   so that those of one slot are in different sets of the cache. */
static inline int64_t mlbatch_row_step(const Scan *scan)
{
    return scan->records ? scan->row_slots + SPARE_SLOTS : scan->row_slots;
}

/* Columns of a sensor that wait for their window: `types.Columns`. */
typedef struct {
    int64_t sensor;
    int64_t columns;
    const int64_t *stamp_ns; /* (columns,) */
    const int64_t *ring_index;
    const int64_t *encoder;
} Part;

/* Words of 8 bytes that identify a stream, and a set of fragments. */
#define STREAM_WORDS 3
#define KEY_WORDS 5

/* A piece of a datagram that is not complete. */
typedef struct {
    int64_t below; /* the next part of the set, of a lower offset, or of the free ones; -1: none */
    int64_t offset;
    int64_t size;
    int64_t start; /* in the data of the call, or in `kept` */
    int64_t is_kept;
    int64_t frame; /* of the call */
} FragmentPart;

/* The pieces of a datagram so far. */
typedef struct {
    uint64_t key[KEY_WORDS]; /* version << 32 | identification, source, destination */
    int64_t birth_ns;        /* receive time of the first one */
    int64_t frames;          /* of this capture */
    int64_t received;        /* bytes */
    int64_t total;           /* bytes of the datagram; -1: not known */
    int64_t top;             /* part with the highest offset */
    int64_t inherited;       /* number among the sets of captures before; -1: none */
} FragmentSet;

/* What is known of a capture from frame to frame. */
typedef struct {
    /* Datagrams found: first byte, size, stream, receive time, as columns (4, room). */
    int64_t room;
    int64_t datagram_count;
    int64_t *datagrams;
    int64_t front;    /* bytes of joined datagrams at the begin of the data */
    int64_t *skipped; /* frames by reason */
    /* Streams (most_streams, STREAM_WORDS) in order of their first packets: source, version << 16 |
       port; slots (slot_count,), more than streams: numbers + 1 by hash, or 0. */
    int64_t most_streams;
    int64_t slot_count;
    int64_t stream_count;
    uint64_t *streams;
    int64_t *stream_slots;
    /* Open sets, oldest first. */
    int64_t most_age_ns;
    int64_t most_sets;
    int64_t set_count;
    FragmentSet *sets;
    int64_t part_count; /* beyond them no part was used */
    int64_t free_part;
    FragmentPart *parts;
    const uint8_t *kept;  /* bytes of parts of earlier calls */
    int64_t held_bytes;   /* of all parts */
    int64_t loose_bytes;  /* of those in the data of the call */
    int64_t now_ns;       /* largest receive time so far */
    int64_t most_first;
    int64_t first_count;
    uint64_t *first_keys; /* (most_first, KEY_WORDS): of the sets that were open first */
    int64_t odd_at;       /* first byte behind the headers of an odd frame */
    int64_t odd_kind;     /* `capture.c`, Packet */
    int64_t *settled;     /* of inherited sets: a reason, -1: open */
} Dissection;

#define NS_PER_S INT64_C(1000000000)

/* Numbers of a few bytes, little-endian, and the other way. */
static inline int64_t number_at(const uint8_t *from, int64_t bytes)
{
    uint64_t value = 0;
    for (int64_t byte = 0; byte < bytes; byte++)
        value |= (uint64_t)from[byte] << 8 * byte;
    return (int64_t)value;
}

static inline int64_t big_endian_at(const uint8_t *from, int64_t bytes)
{
    uint64_t value = 0;
    for (int64_t byte = 0; byte < bytes; byte++)
        value = value << 8 | from[byte];
    return (int64_t)value;
}

static inline int64_t floor_divide(int64_t value, int64_t divisor)
{
    return value / divisor - (value % divisor < 0);
}

static inline int64_t floor_modulo(int64_t value, int64_t divisor)
{
    return value - floor_divide(value, divisor) * divisor;
}

/* Wraps instead of overflowing: numbers of damaged packets are any. */
static inline int64_t sum(int64_t one, int64_t other)
{
    return (int64_t)((uint64_t)one + (uint64_t)other);
}

static inline int64_t difference(int64_t one, int64_t other)
{
    return (int64_t)((uint64_t)one - (uint64_t)other);
}

/* -- layouts of packets: what is read of them but pixels (`headers.c`) --------------------------

   Places of numbers are first bytes of the packet, -1 where it has none. */

/* That some bytes of a packet have a little-endian value. */
typedef struct {
    int64_t first;
    int64_t bytes;
    int64_t value;
} Check;

/* First byte and bytes of packet type, serial number and frame number. */
typedef struct {
    int64_t type[2];
    int64_t serial[2];
    int64_t frame[2];
} Form;

/* Ouster: columns with a timestamp, a position and a status each. A column begins with its
   timestamp, 8 bytes, ns; its position has 2 bytes; bit 0 of the status is set if it was measured.
   The number of a packet is its frame number times `packets_per_frame` plus its rank in the frame;
   it is negative for packets without a rank. */
typedef struct {
    int64_t packet_bytes;
    int64_t columns;
    int64_t first_column;
    int64_t column_bytes;
    int64_t position_at; /* bytes of a column */
    int64_t status_at;
    int64_t positions;  /* of a revolution */
    int64_t form_count; /* 0: columns have the frame number, at `frame_at`, 2 bytes */
    const Form *forms;  /* the second for packets whose serial number is found by it only */
    int64_t packet_type;
    int64_t serial; /* 0: not known */
    int64_t frame_at;
    int64_t frames; /* frame numbers wrap there */
    int64_t rank_count;
    const int64_t *rank; /* of the packets of a frame by block of columns, -1: not sent */
    int64_t packets_per_frame;
} StampedColumns;

/* Velodyne: one timestamp, 4 bytes, us, and blocks with a flag and an azimuth of 2 bytes. A group of
   blocks has one azimuth, and is one column or several. The speed of the rotor follows from the
   steps between groups; a step that is wider than others spans a blind sector, whose duration
   follows from the speed. */
typedef struct {
    int64_t packet_bytes;
    int64_t columns;
    int64_t groups;
    int64_t blocks_per_group;
    int64_t block_count;
    int64_t block_bytes;
    const int64_t *flags; /* (block_count,) in bytes 0 and 1 */
    int64_t circle;       /* azimuths of a revolution */
    int64_t widest;     /* step between groups that may be no gap; a resting rotor steps back less */
    int64_t gap_factor; /* of the middle step, beyond which a wider one is a gap */
    int64_t stamp_at;
    int64_t period_ns;       /* of the timestamps */
    int64_t clock_offset_ns; /* true time minus receive time */
    int64_t mode_at;
    const uint8_t *modes;    /* (256,) not 0: allowed values of the byte there; or NULL */
    const int64_t *start_ns; /* (columns,) after the packet's timestamp */
    const double *ahead_ns;  /* (columns,) after the azimuth of their group */
    double group_ns;         /* from group to group */
    double known_speed;      /* azimuths in a ns, of packets with one group */
    double slowest;          /* below, a wide step is no blind sector */
    double tolerance;        /* of the known speed, which is used across blind sectors */
    int64_t follows_rotor;   /* rotor words have the speed */
} PacedBlocks;

/* HESAI: a date, and blocks with an azimuth each, one block per return. A column is a group of
   blocks. Its time is that of the packet, plus `base_ns`, plus a step for each group, plus
   `first_ns` of its firing table, whose number is (value of `loop_at` + column + 1) modulo 2, or
   follows from operation and azimuth state. */
typedef struct {
    int64_t packet_bytes;
    int64_t columns;
    int64_t returns;
    int64_t first_block;
    int64_t block_bytes;
    int64_t azimuth_at;    /* of the packet, in the first block */
    int64_t azimuth_bytes; /* 2, or 3 with a fine byte */
    int64_t circle;        /* azimuths of a revolution */
    int64_t check_count;
    const Check *checks;
    int64_t has_flags; /* blocks begin with FF EE */
    int64_t mode_at;
    const uint8_t *modes; /* (256,) not 0: allowed values of the byte there; or NULL */
    int64_t date_at;      /* 6 bytes */
    int64_t us_at;        /* 4 bytes */
    int64_t sequence_at;
    int64_t sequence_bytes;
    int64_t operation_at;
    int64_t operations;
    int64_t loop_at;
    int64_t states_at;
    int64_t state_count;
    const int64_t *tables;   /* (operations, state_count) */
    const int64_t *first_ns; /* of each table, of the earliest beam */
    int64_t base_ns;
    const int64_t *step_ns; /* (operations,) of `divisor` groups */
    int64_t divisor;
    int64_t counts_back; /* the last group has step 0, and those before it negative ones */
    int64_t azimuth_ns;  /* when the rotor is at a block's azimuth, after the block's time */
    int64_t rpm_at;
    int64_t rpm_is_signed;
    double turns_per_s; /* of one step of the speed field */
} DatedGroups;

/* ROBOSENSE: one time, 10 bytes, big-endian, seconds and microseconds or calendar, and rows of
   blocks with an id and an azimuth each. The speed of the rotor follows from the steps between
   rows; at most one of them spans a gap in the field of view. */
typedef struct {
    int64_t packet_bytes;
    int64_t columns; /* of a row */
    int64_t rows;
    int64_t first_row;
    int64_t row_bytes;
    int64_t check_count;
    const Check *checks;
    int64_t foreign_count;
    const Check *foreign; /* of device packets on the same topic */
    int64_t point_at;     /* byte that is 0 in point packets */
    int64_t row_id;
    int64_t row_id_bytes;
    int64_t circle; /* azimuths of a revolution */
    int64_t widest; /* step between rows without a gap */
    int64_t time_at;
    int64_t is_calendar;
    int64_t counter_at;      /* 4 bytes, big-endian */
    int64_t repeats;         /* rows of equal azimuth have equal times */
    int64_t row_ns;          /* from row to row */
    const int64_t *start_ns; /* (columns,) after the begin of their row */
    const double *start_s;   /* (columns,) the same */
    double known_speed;      /* azimuths in a s; 0: unknown */
    double turns;            /* revolutions of an azimuth; negative if the rotor is mirrored */
    double following;        /* the same for the speed in rotor words, 0 to ignore it */
} TimedRows;

/* Livox, and clouds of one column each: columns that follow each other evenly. */
typedef struct {
    int64_t packet_bytes;
    int64_t columns;
    int64_t check_count;
    const Check *checks;
    int64_t stamp_at;    /* 8 bytes, ns */
    int64_t interval_at; /* 2 bytes, of all columns */
    int64_t interval_ns; /* a step of it */
    int64_t counter_at;  /* 2 bytes */
    int64_t ring_at;     /* 2 bytes, modulo `rings`: the firing table of the columns */
    int64_t rings;
} EvenColumns;

/* How the headers of a sensor's packets are read: `lidar/headers.py`, HeaderReader. */
typedef struct {
    int64_t kind;
    const void *layout;
    int64_t packet_bytes;
    int64_t columns;
    int64_t has_number;
    const uint64_t *odd; /* factors of the hash of a content */
} Reader;

/* Verdicts on packets: the faults of `lidar.interface.FAULTS`, then the ones of `intake.c`. */
enum { GOOD, BAD_SIZE, BAD_HEADER, BAD_CRC, DUPLICATE, BAD_STAMP, VERDICTS };

/* The header of a packet; that of a packet that is not good is any. */
typedef struct {
    int64_t is_mine; /* it has the serial number of the sensor, or none */
    int64_t fault;   /* GOOD or BAD_HEADER */
    int64_t key;     /* as `Lidar.sequence` */
    /* Of its columns. */
    int64_t *stamp_ns;
    int64_t *encoder;
    uint8_t *valid;
} Header;

/* Packets between one that is read and one whose headers are fetched into the cache. */
enum { HEADERS_AHEAD = 2 };

/* Read a packet that was received at `host_ns`. later: a packet that will be read soon, or NULL;
   content_key: its hash if it is known, or NULL. */
void mlbatch_read_header(const Reader *reader, const uint8_t *packet, const uint8_t *later,
                         int64_t host_ns, const int64_t *content_key, Header *header);

/* Sequence numbers of the packets of a sensor, which wrap: `batching/loss.py`. */
typedef struct {
    int64_t modulus;  /* 0: there are none */
    int64_t newest;   /* -1: none so far */
    int64_t doubtful; /* a number after a long step, until the next one confirms it; -1: none */
    int64_t is_sure;  /* a second number has confirmed the first, which may be a damaged one */
    int64_t lost;
    int64_t reordered;
} Numbers;

/* A packet is a duplicate if its key is that of one of so many packets before it: captures of
   bridged ports repeat packets within milliseconds, a 16-bit frame number repeats after hours. */
enum { DUPLICATE_REACH = 1024, KEY_HEADS = 2048 };

/* What ends a call early: steps of a clock. */
enum { NO_EVENT, RESET, JUMP };

/* The intake of a sensor, from batch to batch: `batching/intake.py`. */
typedef struct {
    const Reader *reader; /* NULL: all headers are given */
    int64_t columns;
    const int64_t *offsets; /* (columns,): ring index of a column after that of its packet */
    Numbers *numbers;
    int64_t offset_ns; /* added to stamps */
    int64_t by_host;   /* stamps are replaced by receive times */
    int64_t finds_jumps;
    int64_t takes_all; /* neither duplicates nor steps are looked for */
    int64_t *rejected; /* (VERDICTS,) */
    int64_t renumbered; /* duplicates with another first stamp */
    /* The newest packets (DUPLICATE_REACH, 3), by number modulo DUPLICATE_REACH: key, first stamp,
       and number of the one before whose key has the same hash; by hash, number of the newest. */
    int64_t packets;
    int64_t *recent;
    int64_t *heads; /* (KEY_HEADS,) */
    int64_t newest_ns;      /* of accepted packets, on the clock of the sensor; NEVER: none */
    int64_t newest_host_ns; /* receive time of the accepted packet before */
    int64_t delivered_ns;   /* newest stamp as it is batched */
    /* The packet that is held until the next one. */
    int64_t is_held;
    int64_t held_host_ns;
    int64_t held_key;
    int64_t held_ring_index;
    int64_t *held_stamp_ns; /* (columns,) */
    int64_t *held_encoder;
    uint8_t *held_valid;
} Intake;

/* Packets of a sensor in a batch, in order of receive time. */
typedef struct {
    int64_t packets;
    const uint8_t *data;
    const int64_t *start;      /* first bytes */
    const int64_t *position;   /* in the batch */
    const int64_t *host_ns;
    const int64_t *ring_index; /* of the first columns */
    const int64_t *keys;       /* hashes of the contents, or NULL */
    uint8_t *owned;            /* by position: which packets of the batch have a sensor */
    /* Headers that were read before, if `is_read`; those of columns are in rows of `Accepted`. */
    int64_t is_read;
    const uint8_t *is_mine;
    const uint8_t *faults;
    const int64_t *given_keys;
} Arrival;

/* Accepted packets, in order of delivery; rows of C columns. There is room for one packet more than
   arrive, and given headers are in all rows but the first. */
typedef struct {
    int64_t *position;
    int64_t *host_ns;
    int64_t *newest_ns; /* largest valid stamp, NEVER without one */
    int64_t *lowest_ns; /* smallest valid stamp, FOREVER without one */
    int64_t *sensor_ns; /* first stamp on the clock of the sensor */
    int64_t *stamp_ns;
    int64_t *encoder;
    int64_t *ring_index;
    uint8_t *valid;
    int64_t read;      /* packets of the sensor, good or not */
    int64_t packets;   /* accepted ones */
    int64_t invalid;   /* columns */
    int64_t oldest;    /* smallest ring index */
    int64_t behind_ns; /* longest time of a column behind the newest stamp before it */
    int64_t ahead_ns;  /* longest step of the newest stamp */
    /* Of an event: the stamps around the step, and the receive times. */
    int64_t before_ns;
    int64_t after_ns;
    int64_t before_host_ns;
    int64_t after_host_ns;
} Accepted;

/* Hash of a packet: `lidar/content_keys.py`. */
static inline int64_t mlbatch_content_key(const uint8_t *packet, int64_t bytes,
                                          const uint64_t *odd)
{
    enum { WORD = 8 };
    const uint64_t golden = UINT64_C(0x9E3779B97F4A7C15);
    const int64_t words = bytes / WORD;
    uint64_t key = 0, part;
    for (int64_t number = 0; number < words; number++) {
        memcpy(&part, packet + WORD * number, WORD);
        key += part * odd[number];
    }
    if (bytes % WORD) {
        memcpy(&part, packet + bytes - WORD, WORD);
        key = key * golden + part;
    }
    key ^= key >> 29;
    return (int64_t)(key * golden >> 1);
}

EXPORT int64_t mlbatch_abi(void);
EXPORT int64_t mlbatch_decode(const Scan *scan);
EXPORT int64_t mlbatch_merge(int64_t part_count, const Part *parts, int64_t until_ns,
                             int64_t *taken, int64_t *stamp_ns, int64_t *sensor,
                             int64_t *ring_index, int64_t *encoder);
EXPORT void mlbatch_figures(int64_t windows, const int64_t *ends, const int64_t *stamp_ns,
                            const int64_t *sensor, const int64_t *encoder, int64_t sensors,
                            const int64_t *positions, int64_t sectors, int64_t *entered,
                            int64_t *figures);
EXPORT void mlbatch_headers(const Reader *reader, const uint8_t *data, int64_t packets,
                            const int64_t *start, const int64_t *host_ns, const int64_t *keys,
                            uint8_t *is_mine, uint8_t *fault, int64_t *key, int64_t *stamp_ns,
                            int64_t *encoder, uint8_t *valid);
EXPORT void mlbatch_numbers(Numbers *numbers, int64_t packets, const int64_t *sequence);
EXPORT int64_t mlbatch_take(Intake *intake, const Arrival *arrival, Accepted *out);
EXPORT int64_t mlbatch_walk(const uint8_t *data, int64_t begin, int64_t end, int64_t is_swapped,
                            int64_t unit_ns, int64_t most_bytes, int64_t room, int64_t *columns,
                            int64_t *stop);
EXPORT int64_t mlbatch_dissect(Dissection *all, uint8_t *data, int64_t first, int64_t frames,
                               const int64_t *start, const int64_t *captured,
                               const int64_t *original, const int64_t *link,
                               const int64_t *host_ns);
EXPORT int64_t mlbatch_keep(Dissection *all, const uint8_t *data, int64_t copies_all, uint8_t *kept,
                            int64_t used);
EXPORT void mlbatch_copy(int64_t runs, const uint8_t *source, const int64_t *source_at,
                         const int64_t *bytes, uint8_t *target, const int64_t *target_at);
EXPORT void mlbatch_sums(int64_t packets, const uint8_t *data, const int64_t *start, int64_t bytes,
                         uint64_t *sums);
EXPORT int64_t mlbatch_cloud_points(int64_t count, const uint8_t *rows, int64_t step,
                              const int64_t *real_at, const int64_t *real_type, int64_t time_type,
                              int64_t fields, const int64_t *field_at, const int64_t *field_bytes,
                              int64_t room, float *reals, uint8_t *const *out, int64_t *placed);
EXPORT int64_t mlbatch_cloud_columns(int64_t count, const int64_t *stamp_ns, const uint16_t *ring,
                               const int64_t *order, int64_t slots, int64_t by_ring,
                               int32_t *column, uint16_t *slot);
EXPORT void mlbatch_cloud_pack(int64_t count, const int64_t *order, const int32_t *column,
                         const uint16_t *slot, const int64_t *stamp_ns, int64_t room,
                         const float *reals, const uint16_t *ring, const uint8_t *return_type,
                         const uint8_t *tag, int64_t slots, int64_t size, int64_t columns,
                         uint16_t *used, uint8_t *packets);
EXPORT int64_t mlbatch_cloud_times(int64_t count, const uint8_t *rows, int64_t step,
                             const int64_t *axes_at, int64_t time_at, int64_t time_type,
                             int64_t room, uint8_t *times, int32_t *number, int32_t *by_order,
                             uint8_t *is_used, int32_t *rank, int64_t *begins, int64_t *figures);
EXPORT int64_t mlbatch_cloud_fill(const uint8_t *rows, int64_t step, const int64_t *fields_at,
                            const int64_t *types, int64_t runs, const int64_t *begins,
                            const int32_t *number, const int32_t *rank, int64_t columns,
                            const int64_t *stamp_ns, const uint8_t *head, int64_t slots,
                            int64_t size, const uint64_t *odd, uint8_t *packets,
                            int64_t *keys);

#endif
