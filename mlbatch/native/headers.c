/* Headers of packets to columns, packet by packet: `lidar/headers.py`.

   A layout describes the packets of a lidar by numbers. Numbers of packets are little-endian unless
   said. Nothing is kept from packet to packet. */
#include <string.h>

#include "native.h"

enum { MOST_BLOCKS = 64 };
enum { NS_PER_US = 1000 };
#define S_PER_DAY INT64_C(86400)

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

static inline double absolute(double value)
{
    return value < 0 ? -value : value;
}

/* A rotor word of `lidar/geometry.py`; revolutions: below 2**51. */
static inline int64_t rotor_word(double revolutions, double revolutions_per_s, int64_t table)
{
    enum { ANGLE_BITS = 32, SPEED_BITS = 24 };
    const double limit = (double)((INT64_C(1) << (SPEED_BITS - 1)) - 1);
    const double steps_per_hz = 0x1p48 * 1e-9;
    double steps = nearest(revolutions_per_s * steps_per_hz);
    steps = steps < -limit ? -limit : steps > limit ? limit : steps;
    const double ticks =
        nearest((revolutions - floor_of(revolutions)) * (double)(INT64_C(1) << ANGLE_BITS));
    const uint64_t angle = (uint64_t)(int64_t)ticks & ((UINT64_C(1) << ANGLE_BITS) - 1);
    const uint64_t speed = (uint64_t)(int64_t)steps & ((UINT64_C(1) << SPEED_BITS) - 1);
    return (int64_t)(angle | speed << ANGLE_BITS | (uint64_t)table << (ANGLE_BITS + SPEED_BITS));
}

/* Days from 1970-01-01 to the first of a month; months count from January 1970. Howard Hinnant,
   days_from_civil. */
static int64_t days_to(int64_t months)
{
    int64_t year = 1970 + floor_divide(months, 12);
    const int64_t month = floor_modulo(months, 12) + 1;
    year -= month <= 2;
    const int64_t era = floor_divide(year, 400);
    const int64_t of_era = year - era * 400;
    const int64_t of_year = (153 * (month + (month > 2 ? -3 : 9)) + 2) / 5;
    return era * 146097 + of_era * 365 + of_era / 4 - of_era / 100 + of_year - 719468;
}

/* -- Ouster: a timestamp and a position in each column ------------------------------------------ */

static inline int64_t field_at(const uint8_t *packet, const int64_t *field)
{
    return number_at(packet + field[0], field[1]);
}

/* Serial number 0: the packet or the metadata have none. */
static int64_t read_form(const StampedColumns *layout, const uint8_t *packet, Header *header)
{
    const Form *form = layout->forms;
    int64_t serial = field_at(packet, form->serial);
    if (layout->serial && serial != layout->serial && layout->form_count > 1
        && field_at(packet, form[1].serial) == layout->serial) {
        form++;
        serial = layout->serial;
    }
    header->is_mine = serial == layout->serial || serial == 0 || layout->serial == 0;
    if (field_at(packet, form->type) != layout->packet_type)
        header->fault = BAD_HEADER;
    return field_at(packet, form->frame);
}

static void read_stamped(const StampedColumns *layout, const uint8_t *packet, Header *header)
{
    const int64_t columns = layout->columns, has_frames = layout->form_count == 0;
    const uint8_t *column = packet + layout->first_column;
    int64_t frame, block = 0, first_frame = 0, measured = 0, within = 0, is_apart = 0;
    for (int64_t number = 0; number < columns; number++, column += layout->column_bytes) {
        memcpy(header->stamp_ns + number, column, sizeof *header->stamp_ns);
        const int64_t position = short_at(column + layout->position_at);
        const int64_t is_measured = column[layout->status_at] & 1;
        const int64_t is_within = is_measured & (position < layout->positions);
        header->encoder[number] = position;
        header->valid[number] = (uint8_t)is_within;
        if (has_frames && is_measured) {
            /* Columns without a header are of one packet: of one frame, and neighbours. */
            const int64_t own = short_at(column + layout->frame_at);
            if (!measured) {
                first_frame = own;
                block = position / columns;
            }
            is_apart |= (own != first_frame) | (position / columns != block);
        }
        measured |= is_measured;
        within |= is_within;
    }
    /* Packets of another mode have no valid column within the frame. */
    if (is_apart || (measured && !within))
        header->fault = BAD_HEADER;
    frame = has_frames ? short_at(packet + layout->first_column + layout->frame_at)
                       : read_form(layout, packet, header);
    frame = floor_modulo(frame, layout->frames);
    block = header->encoder[0] / columns;
    const int64_t rank = block < layout->rank_count ? layout->rank[block] : -1;
    header->key = rank < 0 ? -1 - (frame * layout->rank_count + block)
                           : frame * layout->packets_per_frame + rank;
}

/* -- Velodyne: a timestamp in each packet, an azimuth in each block ----------------------------- */

/* The middle one of some numbers, the lower of two. */
static int64_t middle_of(const int64_t *numbers, int64_t count)
{
    int64_t sorted[MOST_BLOCKS];
    for (int64_t number = 0; number < count; number++) {
        int64_t place = number;
        for (; place > 0 && sorted[place - 1] > numbers[number]; place--)
            sorted[place] = sorted[place - 1];
        sorted[place] = numbers[number];
    }
    return sorted[(count - 1) / 2];
}

/* Speed of the rotor, azimuths in a ns, and the time that blind sectors add before each group. */
static double paced_speed(const PacedBlocks *layout, const int64_t *azimuth, int64_t *delay_ns)
{
    const int64_t steps = layout->groups - 1;
    int64_t step[MOST_BLOCKS], total = 0, count = 0, is_wide = 0;
    memset(delay_ns, 0, (size_t)layout->groups * sizeof *delay_ns);
    if (!steps)
        return layout->known_speed;
    for (int64_t one = 0; one < steps; one++) {
        const int64_t turned = azimuth[one + 1] - azimuth[one] + layout->widest;
        step[one] = floor_modulo(turned, layout->circle) - layout->widest;
        is_wide |= step[one] > layout->widest;
    }
    const int64_t most = is_wide ? layout->gap_factor * middle_of(step, steps) : 0;
    for (int64_t one = 0; one < steps; one++)
        if (!(step[one] > layout->widest && step[one] > most)) {
            total += step[one];
            count++;
        }
    const double speed = (double)total / (double)count / layout->group_ns;
    if (count == steps)
        return speed;
    /* Across half a revolution, the speed over many packets is better than over a few blocks. */
    const double known = layout->known_speed;
    const double steady = absolute(speed - known) < layout->tolerance * known ? known : speed;
    double late_ns = 0;
    for (int64_t one = 0; one < steps; one++) {
        if (step[one] > layout->widest && step[one] > most && steady > layout->slowest)
            late_ns += (double)step[one] / steady - layout->group_ns;
        delay_ns[one + 1] = (int64_t)nearest(late_ns);
    }
    return speed;
}

static void read_paced(const PacedBlocks *layout, const uint8_t *packet, int64_t host_ns,
                       Header *header)
{
    int64_t azimuth[MOST_BLOCKS], delay_ns[MOST_BLOCKS];
    int64_t is_good = !layout->modes || layout->modes[packet[layout->mode_at]];
    for (int64_t block = 0; block < layout->block_count; block++) {
        const uint8_t *from = packet + block * layout->block_bytes;
        is_good &= short_at(from) == layout->flags[block];
        is_good &= short_at(from + 2) <= layout->circle;
    }
    for (int64_t group = 0; group < layout->groups; group++) {
        const int64_t at = group * layout->blocks_per_group * layout->block_bytes + 2;
        azimuth[group] = short_at(packet + at);
        if (azimuth[group] == layout->circle)
            azimuth[group] = 0;
    }
    const int64_t period_ns = layout->period_ns;
    const int64_t part_ns = number_at(packet + layout->stamp_at, 4) * NS_PER_US;
    if (!is_good || part_ns >= period_ns)
        header->fault = BAD_HEADER;
    const int64_t near_ns = sum(host_ns, layout->clock_offset_ns);
    const int64_t periods = floor_divide(sum(near_ns, period_ns / 2 - part_ns), period_ns);
    const int64_t packet_ns = sum(part_ns, (int64_t)((uint64_t)periods * (uint64_t)period_ns));
    const double speed = paced_speed(layout, azimuth, delay_ns);
    const double per_s = (double)NS_PER_S / (double)layout->circle;
    const double turns_per_s = (layout->follows_rotor ? speed : 0.0) * per_s;
    const int64_t halves = layout->columns / layout->groups;
    for (int64_t column = 0; column < layout->columns; column++) {
        const int64_t group = column / halves;
        const double ahead = speed * layout->ahead_ns[column];
        const double turns = ((double)azimuth[group] + ahead) / (double)layout->circle;
        header->encoder[column] = rotor_word(turns, turns_per_s, 0);
        header->stamp_ns[column] =
            sum(sum(packet_ns, delay_ns[group]), layout->start_ns[column]);
    }
    memset(header->valid, 1, (size_t)layout->columns);
}

/* -- HESAI: a date in each packet, an azimuth in each block ------------------------------------- */

/* Time of a packet, ns since 1970; clears `is_good` where a date or time is none. */
static int64_t dated_ns(const DatedGroups *layout, const uint8_t *packet, int64_t *is_good)
{
    const uint8_t *date = packet + layout->date_at;
    const int64_t us = number_at(packet + layout->us_at, 4);
    const int64_t most_s = INT64_C(9000000000), most_us = 1000000, century = 70;
    int64_t seconds, is_date;
    if (date[0] == 0) {
        seconds = big_endian_at(date + 1, 5);
        is_date = seconds <= most_s;
    } else {
        const int64_t year = date[0] < century ? date[0] + 30 : date[0] - century;
        const int64_t months = year * 12 + date[1] - 1;
        const int64_t first_day = days_to(months);
        is_date = date[1] >= 1 && date[1] <= 12 && date[2] >= 1
            && date[2] <= days_to(months + 1) - first_day && date[3] < 24 && date[4] < 60
            && date[5] < 60;
        seconds = (first_day + date[2] - 1) * S_PER_DAY + date[3] * 3600 + date[4] * 60 + date[5];
    }
    is_date &= us <= most_us;
    *is_good &= is_date;
    return (is_date ? seconds : 0) * NS_PER_S + us * NS_PER_US;
}

/* Firing table of a column. */
static int64_t table_of(const DatedGroups *layout, const uint8_t *packet, int64_t operation,
                        int64_t column)
{
    if (layout->loop_at >= 0)
        return (packet[layout->loop_at] + column + 1) % 2;
    if (layout->states_at < 0)
        return 0;
    const int64_t shift = 14 - 2 * layout->returns * column;
    const int64_t state = shift < 0 ? 0 : short_at(packet + layout->states_at) >> shift & 3;
    return layout->tables[operation * layout->state_count + state];
}

static int64_t dated_azimuth(const DatedGroups *layout, const uint8_t *packet, int64_t block)
{
    const uint8_t *from = packet + layout->azimuth_at + block * layout->block_bytes;
    const int64_t azimuth = short_at(from);
    return layout->azimuth_bytes > 2 ? azimuth << 8 | from[2] : azimuth;
}

static void read_dated(const DatedGroups *layout, const uint8_t *packet, Header *header)
{
    const int64_t columns = layout->columns, returns = layout->returns;
    int64_t is_good = has_values(packet, layout->check_count, layout->checks);
    is_good &= !layout->modes || layout->modes[packet[layout->mode_at]];
    const int64_t packet_ns = dated_ns(layout, packet, &is_good);
    const int64_t operation =
        layout->operation_at < 0 ? 0 : packet[layout->operation_at] % layout->operations;
    double speed = 0;
    if (layout->rpm_at >= 0) {
        int64_t steps = short_at(packet + layout->rpm_at);
        if (layout->rpm_is_signed && steps >= 1 << 15)
            steps = (1 << 16) - steps;
        speed = (double)steps * layout->turns_per_s;
    }
    for (int64_t column = 0; column < columns; column++) {
        const int64_t azimuth = dated_azimuth(layout, packet, column * returns);
        for (int64_t which = 0; which < returns; which++) {
            const uint8_t *block = packet + layout->first_block
                + (column * returns + which) * layout->block_bytes;
            is_good &= dated_azimuth(layout, packet, column * returns + which) == azimuth;
            is_good &= !layout->has_flags || (block[0] == 0xFF && block[1] == 0xEE);
        }
        is_good &= azimuth <= layout->circle;
        const int64_t group = layout->counts_back ? column - (columns - 1) : column;
        const int64_t table = table_of(layout, packet, operation, column);
        const int64_t first_ns = layout->first_ns[table];
        const int64_t offset_ns =
            layout->base_ns + floor_divide(layout->step_ns[operation] * group, layout->divisor);
        const double ahead = speed * ((double)(first_ns - layout->azimuth_ns) * 1e-9);
        const double turns = (double)azimuth / (double)layout->circle + ahead;
        header->encoder[column] = rotor_word(turns, speed, table);
        header->stamp_ns[column] = sum(packet_ns, offset_ns + first_ns);
    }
    memset(header->valid, 1, (size_t)columns);
    if (!is_good)
        header->fault = BAD_HEADER;
    if (layout->sequence_at >= 0)
        header->key = number_at(packet + layout->sequence_at, layout->sequence_bytes);
}

/* -- ROBOSENSE: a timestamp in each packet, an azimuth in each row of blocks -------------------- */

static int64_t timed_ns(const TimedRows *layout, const uint8_t *packet, int64_t *is_good)
{
    const uint8_t *time = packet + layout->time_at;
    const int64_t most_s = INT64_C(1) << 33;
    if (!layout->is_calendar) {
        const int64_t second = big_endian_at(time, 6), micro = big_endian_at(time + 6, 4);
        *is_good &= second < most_s && micro < 1000000;
        return second % most_s * NS_PER_S + micro * NS_PER_US;
    }
    const int64_t milli = big_endian_at(time + 6, 2), micro = big_endian_at(time + 8, 2);
    *is_good &= milli < 1000 && micro < 1000 && time[1] >= 1 && time[1] <= 12 && time[2] >= 1
        && time[2] <= 31 && time[3] <= 23 && time[4] <= 59 && time[5] <= 60;
    /* Lengths of months are not checked: days 29 to 31 may run into the next month. */
    const int64_t days = days_to(12 * (30 + (int64_t)time[0]) + time[1] - 1) + time[2] - 1;
    const int64_t seconds = ((days * 24 + time[3]) * 60 + time[4]) * 60 + time[5];
    return seconds * NS_PER_S + (milli * 1000 + micro) * NS_PER_US;
}

/* Speed of the rotor, azimuths in a s, and the begin of each row. The duration of a gap in the
   field of view follows from its angle; a packet has at most one, else an azimuth is damaged. */
static double timed_speed(const TimedRows *layout, const int64_t *azimuth, const uint8_t *valid,
                          int64_t *begin_ns)
{
    const int64_t half = layout->circle / 2;
    int64_t rotated = 0, count = 0, gaps = 0, gap_at = -1;
    begin_ns[0] = 0;
    for (int64_t row = 1; row < layout->rows; row++) {
        int64_t wait_ns = layout->row_ns;
        if (valid[row] && valid[row - 1]) {
            const int64_t step =
                floor_modulo(azimuth[row] - azimuth[row - 1] + half, layout->circle) - half;
            if (layout->repeats && step == 0) {
                wait_ns = 0;
            } else if (step > layout->widest || -step > layout->widest) {
                gaps++;
                gap_at = row;
            } else {
                rotated += step;
                count++;
            }
        }
        begin_ns[row] = begin_ns[row - 1] + wait_ns;
    }
    const double known = layout->known_speed;
    if (gaps == 1 && known != 0.0) {
        const int64_t step = azimuth[gap_at] - azimuth[gap_at - 1];
        const int64_t forward = floor_modulo(known > 0 ? step : -step, layout->circle);
        const double bridge_ns = nearest((double)forward * ((double)NS_PER_S / absolute(known)));
        const int64_t more_ns = (int64_t)bridge_ns - layout->row_ns;
        for (int64_t row = gap_at; row < layout->rows; row++)
            begin_ns[row] += more_ns;
    }
    if (!count)
        return known;
    return (double)rotated * ((double)NS_PER_S / (double)layout->row_ns) / (double)count;
}

static void read_timed(const TimedRows *layout, const uint8_t *packet, Header *header)
{
    int64_t azimuth[MOST_BLOCKS], begin_ns[MOST_BLOCKS];
    uint8_t valid[MOST_BLOCKS];
    header->is_mine = !has_values(packet, layout->foreign_count, layout->foreign)
        && (layout->point_at < 0 || packet[layout->point_at] == 0);
    int64_t is_good = has_values(packet, layout->check_count, layout->checks);
    const int64_t packet_ns = timed_ns(layout, packet, &is_good);
    if (!is_good)
        header->fault = BAD_HEADER;
    for (int64_t row = 0; row < layout->rows; row++) {
        const uint8_t *from = packet + layout->first_row + row * layout->row_bytes;
        azimuth[row] = big_endian_at(from + 2, 2);
        valid[row] = azimuth[row] <= layout->circle
            && number_at(from, layout->row_id_bytes) == layout->row_id;
        azimuth[row] %= layout->circle;
    }
    const double speed = timed_speed(layout, azimuth, valid, begin_ns);
    const double turns_per_s = layout->following * speed;
    for (int64_t row = 0; row < layout->rows; row++)
        for (int64_t one = 0; one < layout->columns; one++) {
            const int64_t column = row * layout->columns + one;
            const double at = (double)azimuth[row] + speed * layout->start_s[one];
            header->encoder[column] = rotor_word(layout->turns * at, turns_per_s, 0);
            header->stamp_ns[column] =
                sum(packet_ns, begin_ns[row] + layout->start_ns[one]);
            header->valid[column] = valid[row];
        }
    if (layout->counter_at >= 0)
        header->key = big_endian_at(packet + layout->counter_at, 4);
}

/* -- points that follow each other evenly, and packets of one column ---------------------------- */

static void read_even(const EvenColumns *layout, const uint8_t *packet, Header *header)
{
    if (!has_values(packet, layout->check_count, layout->checks))
        header->fault = BAD_HEADER;
    int64_t first_ns, interval_ns = 0, ring = 0;
    memcpy(&first_ns, packet + layout->stamp_at, sizeof first_ns);
    if (layout->interval_at >= 0)
        interval_ns = short_at(packet + layout->interval_at) * layout->interval_ns;
    if (layout->ring_at >= 0)
        ring = short_at(packet + layout->ring_at) % layout->rings;
    for (int64_t column = 0; column < layout->columns; column++) {
        header->stamp_ns[column] = sum(first_ns, interval_ns * column / layout->columns);
        header->encoder[column] = rotor_word(0, 0, ring);
        header->valid[column] = 1;
    }
    if (layout->counter_at >= 0)
        header->key = short_at(packet + layout->counter_at);
}

/* -- packets ------------------------------------------------------------------------------------ */

/* As in `lidar/headers.py`. */
enum { STAMPED, PACED, DATED, TIMED, EVEN };

void mlbatch_read_header(const Reader *reader, const uint8_t *packet, const uint8_t *later,
                         int64_t host_ns, const int64_t *content_key, Header *header)
{
    const void *layout = reader->layout;
    if (later) {
        const int64_t step = reader->packet_bytes / reader->columns;
        if (reader->kind == STAMPED)
            later += ((const StampedColumns *)layout)->first_column;
        for (int64_t column = 0; column < reader->columns; column++)
            __builtin_prefetch(later + column * step);
    }
    header->is_mine = 1;
    header->fault = GOOD;
    header->key = 0;
    switch (reader->kind) {
    case STAMPED: read_stamped(layout, packet, header); break;
    case PACED: read_paced(layout, packet, host_ns, header); break;
    case DATED: read_dated(layout, packet, header); break;
    case TIMED: read_timed(layout, packet, header); break;
    default: read_even(layout, packet, header);
    }
    if (!reader->has_number)
        header->key = content_key ? *content_key
                                  : mlbatch_content_key(packet, reader->packet_bytes, reader->odd);
}

/* Read the headers of packets in any order and state; keys: see `mlbatch_read_header`, or NULL.
   stamp_ns, encoder, valid: (packets, columns of a packet). */
EXPORT void mlbatch_headers(const Reader *reader, const uint8_t *data, int64_t packets,
                            const int64_t *start, const int64_t *host_ns, const int64_t *keys,
                            uint8_t *is_mine, uint8_t *fault, int64_t *key, int64_t *stamp_ns,
                            int64_t *encoder, uint8_t *valid)
{
    for (int64_t number = 0; number < packets; number++) {
        const int64_t first = number * reader->columns;
        Header header = {0, 0, 0, stamp_ns + first, encoder + first, valid + first};
        const int64_t later = number + HEADERS_AHEAD;
        mlbatch_read_header(reader, data + start[number],
                            later < packets ? data + start[later] : NULL, host_ns[number],
                            keys ? keys + number : NULL, &header);
        is_mine[number] = (uint8_t)header.is_mine;
        fault[number] = (uint8_t)header.fault;
        key[number] = header.key;
    }
}
