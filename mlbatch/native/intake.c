/* Packets of one sensor to accepted columns, packet by packet: the rules of docs/batching.md.

   A packet is its sensor's, good, no duplicate, and within a second of the newest stamp of its
   sensor; or a step, which the next packet confirms or refutes. State is kept from batch to batch,
   so that the result does not depend on how packets are grouped. */
#include "native.h"

#define NEVER (-(INT64_C(1) << 62))
#define FOREVER (INT64_C(1) << 62)
/* A packet whose stamps differ more than this from the newest one needs confirmation. */
#define STEP_NS NS_PER_S
#define LIMIT_NS ((INT64_C(1) << 31) * NS_PER_S)
/* A longer step of sequence numbers needs the next packet as confirmation: one flipped bit in a
   frame number must not count as a million lost packets. */
#define BELIEVED_STEP 1024

/* A packet of the batch, or the one that is held. */
typedef struct {
    Header header;
    int64_t position;
    int64_t host_ns;
    int64_t ring_index;
    int64_t low_ns; /* of the valid columns; FOREVER and NEVER without one */
    int64_t high_ns;
    int64_t first_ns; /* of the first valid column */
} Packet;

/* -- sequence numbers --------------------------------------------------------------------------- */

static int64_t signed_step(int64_t step, int64_t modulus)
{
    return floor_modulo(step + modulus / 2, modulus) - modulus / 2;
}

static int is_long(int64_t step)
{
    return step > BELIEVED_STEP || step < -BELIEVED_STEP;
}

static void count_number(Numbers *numbers, int64_t number)
{
    if (!numbers->modulus || number < 0)
        return;
    if (numbers->newest < 0) {
        numbers->newest = number;
        return;
    }
    const int64_t step = signed_step(number - numbers->newest, numbers->modulus);
    if (is_long(step)) {
        if (numbers->doubtful < 0
            || is_long(signed_step(number - numbers->doubtful, numbers->modulus))) {
            numbers->doubtful = number;
            return;
        }
        /* A long gap forward is loss; a step back is a restart of the count. */
        if (step > 0 && numbers->is_sure)
            numbers->lost += step - 2;
        numbers->newest = number;
    } else if (step > 0) {
        numbers->lost += step - 1;
        numbers->newest = number;
    } else if (step < 0) {
        numbers->reordered++;
        numbers->lost -= numbers->lost > 0;
    }
    numbers->doubtful = -1;
    numbers->is_sure = 1;
}

/* Count accepted packets in order of receive time. */
EXPORT void mlbatch_numbers(Numbers *numbers, int64_t packets, const int64_t *sequence)
{
    for (int64_t packet = 0; packet < packets; packet++)
        count_number(numbers, sequence[packet]);
}

/* -- rules -------------------------------------------------------------------------------------- */

/* Whether one of the last DUPLICATE_REACH packets, accepted or not, had this key; remembers it.
   Negative keys identify nothing. */
static int is_duplicate(Intake *intake, int64_t key, int64_t first_ns)
{
    enum { KEY, FIRST, BEFORE, WORDS };
    const int64_t number = ++intake->packets;
    if (key < 0)
        return 0;
    const uint64_t hash = (uint64_t)key * UINT64_C(0x9E3779B97F4A7C15);
    int64_t *head = intake->heads + (hash >> 32) % KEY_HEADS, *found = NULL;
    for (int64_t at = *head; at > 0 && number - at <= DUPLICATE_REACH && !found;) {
        int64_t *known = intake->recent + at % DUPLICATE_REACH * WORDS;
        if (known[KEY] == key)
            found = known;
        at = known[BEFORE];
    }
    const int is_known = found != NULL;
    intake->renumbered += is_known && found[FIRST] != first_ns;
    int64_t *own = intake->recent + number % DUPLICATE_REACH * WORDS;
    own[KEY] = key;
    own[FIRST] = first_ns;
    own[BEFORE] = *head;
    *head = number;
    return is_known;
}

/* Extremes of the valid stamps. */
static void measure(Packet *packet, int64_t columns)
{
    packet->low_ns = FOREVER;
    packet->high_ns = NEVER;
    packet->first_ns = NEVER;
    for (int64_t column = columns - 1; column >= 0; column--) {
        const int64_t stamp_ns = packet->header.stamp_ns[column];
        if (!packet->header.valid[column])
            continue;
        packet->low_ns = stamp_ns < packet->low_ns ? stamp_ns : packet->low_ns;
        packet->high_ns = stamp_ns > packet->high_ns ? stamp_ns : packet->high_ns;
        packet->first_ns = stamp_ns;
    }
}

static int is_near(const Packet *packet, int64_t stamp_ns)
{
    return packet->low_ns >= stamp_ns - STEP_NS && packet->high_ns <= stamp_ns + STEP_NS;
}

static void copy_columns(Header *to, const Header *from, int64_t columns)
{
    memmove(to->stamp_ns, from->stamp_ns, (size_t)columns * sizeof *to->stamp_ns);
    memmove(to->encoder, from->encoder, (size_t)columns * sizeof *to->encoder);
    memmove(to->valid, from->valid, (size_t)columns);
}

static Header held_header(const Intake *intake)
{
    Header header = {1, GOOD, intake->held_key, intake->held_stamp_ns, intake->held_encoder,
                     intake->held_valid};
    return header;
}

static void hold(Intake *intake, const Packet *packet)
{
    Header held = held_header(intake);
    copy_columns(&held, &packet->header, intake->columns);
    intake->is_held = 1;
    intake->held_key = packet->header.key;
    intake->held_host_ns = packet->host_ns;
    intake->held_ring_index = packet->ring_index;
}

/* Columns of row `row`. */
static Header header_at(const Intake *intake, const Accepted *out, int64_t row)
{
    const int64_t first = row * intake->columns;
    Header header = {1, GOOD, 0, out->stamp_ns + first, out->encoder + first, out->valid + first};
    return header;
}

static int64_t note(Accepted *out, int64_t event, int64_t before_ns, int64_t after_ns,
                    int64_t before_host_ns, int64_t after_host_ns)
{
    out->before_ns = before_ns;
    out->after_ns = after_ns;
    out->before_host_ns = before_host_ns;
    out->after_host_ns = after_host_ns;
    return event;
}

/* Deliver an accepted packet as the next row. */
static void deliver(Intake *intake, Accepted *out, Packet *packet)
{
    const int64_t row = out->packets++, columns = intake->columns;
    Header header = header_at(intake, out, row);
    if (header.stamp_ns != packet->header.stamp_ns)
        copy_columns(&header, &packet->header, columns);
    int64_t shift_ns = 0;
    if (packet->high_ns > NEVER) {
        if (packet->high_ns > intake->newest_ns)
            intake->newest_ns = packet->high_ns;
        intake->newest_host_ns = packet->host_ns;
        /* The newest column has the receive time, the others are as much older as they were. */
        if (intake->by_host)
            shift_ns = difference(packet->host_ns, packet->high_ns);
    }
    out->position[row] = packet->position;
    out->host_ns[row] = packet->host_ns;
    out->newest_ns[row] = sum(packet->high_ns, shift_ns);
    out->lowest_ns[row] = sum(packet->low_ns, shift_ns);
    out->sensor_ns[row] = header.stamp_ns[0];
    int64_t newest_ns = intake->delivered_ns;
    for (int64_t column = 0; column < columns; column++) {
        const int64_t ring_index = packet->ring_index + intake->offsets[column];
        out->ring_index[row * columns + column] = ring_index;
        if (ring_index < out->oldest)
            out->oldest = ring_index;
        if (!header.valid[column]) {
            out->invalid++;
            continue;
        }
        const int64_t stamp_ns = sum(header.stamp_ns[column], shift_ns);
        header.stamp_ns[column] = stamp_ns;
        if (stamp_ns < newest_ns) {
            const int64_t behind_ns = difference(newest_ns, stamp_ns);
            out->behind_ns = behind_ns > out->behind_ns ? behind_ns : out->behind_ns;
            continue;
        }
        const int64_t ahead_ns = newest_ns > NEVER ? difference(stamp_ns, newest_ns) : 0;
        out->ahead_ns = ahead_ns > out->ahead_ns ? ahead_ns : out->ahead_ns;
        newest_ns = stamp_ns;
    }
    intake->delivered_ns = newest_ns;
    count_number(intake->numbers, packet->header.key);
}

/* Deliver a packet with a valid column, unless the stamps have stepped forward by more than
   receive times: after a silence both have advanced by the same time. No time has passed between
   packets that share the receive time of a message. */
static int64_t accept(Intake *intake, Accepted *out, Packet *packet)
{
    const int64_t newest_ns = intake->newest_ns;
    if (intake->finds_jumps && newest_ns > NEVER) {
        const int64_t step_ns = packet->high_ns - newest_ns;
        const int64_t passed_ns = difference(packet->host_ns, intake->newest_host_ns);
        if (passed_ns > 0 && step_ns - STEP_NS > passed_ns)
            return note(out, JUMP, newest_ns, packet->high_ns, intake->newest_host_ns,
                        packet->host_ns);
    }
    deliver(intake, out, packet);
    return NO_EVENT;
}

/* Confirm the step of the packet that is held, by one that is near it: forward it was a gap,
   backward the clock was reset. With stamps of the host only ages within a packet matter. */
static int64_t confirm(Intake *intake, Accepted *out, int64_t position)
{
    Packet held = {held_header(intake), position, intake->held_host_ns, intake->held_ring_index,
                   0, 0, 0};
    measure(&held, intake->columns);
    if (held.first_ns < intake->newest_ns) {
        if (!intake->by_host)
            return note(out, RESET, intake->newest_ns, held.first_ns, intake->newest_host_ns,
                        held.host_ns);
        intake->newest_ns = NEVER;
    }
    intake->is_held = 0;
    return accept(intake, out, &held);
}

/* First valid stamp of the packet that is held. */
static int64_t held_first_ns(const Intake *intake)
{
    Packet held = {held_header(intake), 0, 0, 0, 0, 0, 0};
    measure(&held, intake->columns);
    return held.first_ns;
}

static int64_t reject(Intake *intake, int64_t verdict)
{
    intake->rejected[verdict]++;
    return NO_EVENT;
}

/* Accept, hold or reject a packet of the sensor. */
static int64_t take(Intake *intake, Accepted *out, Packet *packet)
{
    if (packet->header.fault)
        return reject(intake, packet->header.fault);
    int64_t *stamp_ns = packet->header.stamp_ns;
    if (!intake->takes_all && is_duplicate(intake, packet->header.key, stamp_ns[0]))
        return reject(intake, DUPLICATE);
    for (int64_t column = 0; column < intake->columns; column++)
        stamp_ns[column] = sum(stamp_ns[column], intake->offset_ns);
    measure(packet, intake->columns);
    if (!intake->takes_all
        && (packet->low_ns < 0 || packet->high_ns >= LIMIT_NS
            || packet->high_ns - packet->low_ns > STEP_NS))
        return reject(intake, BAD_STAMP);
    /* Without a valid column it neither confirms nor refutes a step. */
    if (intake->takes_all || packet->high_ns == NEVER) {
        deliver(intake, out, packet);
        return NO_EVENT;
    }
    int steps = intake->newest_ns > NEVER && !is_near(packet, intake->newest_ns);
    if (intake->is_held) {
        if (steps && is_near(packet, held_first_ns(intake))) {
            const int64_t event = confirm(intake, out, packet->position);
            if (event)
                return event;
            steps = 0;
        } else {
            intake->is_held = 0;
            reject(intake, BAD_STAMP);
        }
    }
    if (!steps)
        return accept(intake, out, packet);
    hold(intake, packet);
    return NO_EVENT;
}

/* -- a batch ------------------------------------------------------------------------------------ */

/* Take the packets of a batch that are the sensor's and no other sensor's; return NO_EVENT, or the
   step of a clock at which the call ended. */
EXPORT int64_t mlbatch_take(Intake *intake, const Arrival *arrival, Accepted *out)
{
    out->read = out->packets = out->invalid = out->behind_ns = out->ahead_ns = 0;
    out->oldest = FOREVER;
    int64_t event = NO_EVENT;
    for (int64_t number = 0; number < arrival->packets && !event; number++) {
        /* Behind the row of a packet that is held, which may come first. */
        const int64_t row = arrival->is_read ? number + 1 : out->packets + intake->is_held;
        Packet packet = {header_at(intake, out, row), arrival->position[number],
                         arrival->host_ns[number], arrival->ring_index[number], 0, 0, 0};
        if (arrival->is_read) {
            packet.header.is_mine = arrival->is_mine[number];
            packet.header.fault = arrival->faults[number];
            packet.header.key = arrival->given_keys[number];
        } else {
            const int64_t later = number + HEADERS_AHEAD;
            mlbatch_read_header(
                intake->reader, arrival->data + arrival->start[number],
                later < arrival->packets ? arrival->data + arrival->start[later] : NULL,
                packet.host_ns, arrival->keys ? arrival->keys + number : NULL, &packet.header);
        }
        if (!packet.header.is_mine || arrival->owned[packet.position])
            continue;
        arrival->owned[packet.position] = 1;
        out->read++;
        event = take(intake, out, &packet);
    }
    return event;
}
