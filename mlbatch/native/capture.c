/* Captures: records of a pcap file to frames, frames to UDP datagrams, fragments to datagrams.

   Layouts: draft-ietf-opsawg-pcap, section 5; ethertypes and numbers of headers: IANA; RFC 791
   (IPv4), 8200 (IPv6), 4302 (authentication header), 768 (UDP). */
#include <string.h>

#include "native.h"

enum { RECORD_BYTES = 16, IPV4_BYTES = 20, IPV6_BYTES = 40, UDP_BYTES = 8 };
enum { IPV4_TYPE = 0x0800, IPV6_TYPE = 0x86DD, MPLS_TYPE = 0x8847, PPPOE_TYPE = 0x8864 };
enum { MORE_FRAGMENTS = 0x2000, FRAGMENT_OFFSET = 0x1FFF, MOST_DATAGRAM_BYTES = 65535 };
/* Protocols, and headers of IPv6. */
enum { HOP_BY_HOP, IPV4_IN_IP = 4, UDP = 17, IPV6_IN_IP = 41, ROUTING = 43, FRAGMENT_HEADER };
enum { GRE = 47, AUTHENTICATION = 51, DESTINATION = 60, MOBILITY = 135, HOST_IDENTITY = 139, SHIM6 };
/* No network adds more; the bounds keep a crafted packet cheap. */
enum { MOST_TAGS = 8, MOST_HEADERS = 16 };
/* Why a walk ends: `native/capture.py`. */
enum { NO_ROOM, CUT, TOO_LONG };
/* Headers of so many frames ahead are asked for: what was just read is in no near cache. */
enum { FRAMES_AHEAD = 4, LINE = 64 };

static int64_t word_of(const uint8_t *byte, int64_t is_swapped)
{
    return is_swapped ? big_endian_at(byte, 4) : number_at(byte, 4);
}

/* Frames of the records in data[begin:end]: first byte, captured and original length, receive
   time, as columns (4, room). Return their number; stop: where the next record begins, and why the
   walk ended there. */
EXPORT int64_t mlbatch_walk(const uint8_t *data, int64_t begin, int64_t end, int64_t is_swapped,
                            int64_t unit_ns, int64_t most_bytes, int64_t room, int64_t *columns,
                            int64_t *stop)
{
    int64_t count = 0, place = begin, why = NO_ROOM;
    for (; count < room; count++) {
        if (place + RECORD_BYTES > end) {
            why = CUT;
            break;
        }
        const uint8_t *record = data + place;
        const int64_t size = word_of(record + 8, is_swapped);
        if (size > most_bytes) {
            why = TOO_LONG;
            break;
        }
        if (place + RECORD_BYTES + size > end) {
            why = CUT;
            break;
        }
        /* Most frames are as long as the one before. */
        const int64_t ahead = place + FRAMES_AHEAD * (RECORD_BYTES + size);
        if (ahead < end)
            __builtin_prefetch(data + ahead);
        columns[count] = place + RECORD_BYTES;
        columns[room + count] = size;
        columns[2 * room + count] = word_of(record + 12, is_swapped);
        columns[3 * room + count] =
            word_of(record, is_swapped) * NS_PER_S + word_of(record + 4, is_swapped) * unit_ns;
        place += RECORD_BYTES + size;
    }
    stop[0] = place;
    stop[1] = why;
    return count;
}

/* -- frames to datagrams and fragments ----------------------------------------------------- */

/* Verdicts on a frame. The first ones are counted: `CAPTURE_REASONS` of the ledger. */
enum { NOT_IP, NOT_UDP, TRUNCATED, FRAGMENT, FRAGMENT_LOST, WHOLE, PART, ODD };

/* Content of a frame: a datagram from its UDP header on (WHOLE), a piece of one (PART), or (ODD)
   something that an IP packet may be in. */
typedef struct {
    uint64_t key[KEY_WORDS]; /* as of `FragmentSet`; a datagram has no identification */
    int64_t start;
    int64_t size;
    int64_t offset; /* of the piece */
    int64_t more;   /* whether pieces follow */
    int64_t kind;   /* of what is odd: ethertype, protocol, or link type, less than 0 */
} Packet;

static int read_odd(int64_t at, int64_t kind, Packet *packet)
{
    packet->start = at;
    packet->kind = kind;
    return ODD;
}

static int is_tunnel(int protocol)
{
    return protocol == IPV4_IN_IP || protocol == IPV6_IN_IP || protocol == GRE;
}

/* A datagram is as long as its UDP header says, if that many bytes were captured: some sensors
   announce a wrong IP length, and Ethernet pads short frames. */
static int read_udp(const uint8_t *data, int64_t at, int64_t stop, Packet *packet)
{
    if (at + UDP_BYTES > stop)
        return TRUNCATED;
    packet->start = at;
    packet->size = big_endian_at(data + at + 4, 2);
    return packet->size < UDP_BYTES || at + packet->size > stop ? TRUNCATED : WHOLE;
}

/* A fragment has no UDP length: its IP length, which gives its end, has to be right. */
static int read_part(int64_t at, int64_t end, int64_t stop, Packet *packet)
{
    packet->start = at;
    packet->size = end - at;
    return end <= at || end > stop ? TRUNCATED : PART;
}

static int read_ipv4(const uint8_t *data, int64_t at, int64_t stop, Packet *packet)
{
    if (at + IPV4_BYTES > stop)
        return TRUNCATED;
    const uint8_t *header = data + at;
    const int64_t body = at + (header[0] & 15) * 4, place = big_endian_at(header + 6, 2);
    const int is_part = (place & (MORE_FRAGMENTS | FRAGMENT_OFFSET)) != 0;
    if (header[0] >> 4 != 4 || body < at + IPV4_BYTES)
        return NOT_IP;
    if (is_tunnel(header[9]) && !is_part && body < stop)
        return read_odd(body, header[9], packet);
    if (header[9] != UDP)
        return NOT_UDP;
    packet->key[0] = UINT64_C(4) << 32;
    packet->key[1] = packet->key[3] = 0;
    packet->key[2] = (uint64_t)big_endian_at(header + 12, 4);
    packet->key[4] = (uint64_t)big_endian_at(header + 16, 4);
    if (!is_part)
        return read_udp(data, body, stop, packet);
    packet->key[0] |= (uint64_t)big_endian_at(header + 4, 2);
    packet->offset = (place & FRAGMENT_OFFSET) * 8;
    packet->more = (place & MORE_FRAGMENTS) != 0;
    return read_part(body, at + big_endian_at(header + 2, 2), stop, packet);
}

static int read_ipv6(const uint8_t *data, int64_t at, int64_t stop, Packet *packet)
{
    if (at + IPV6_BYTES > stop)
        return TRUNCATED;
    if (data[at] >> 4 != 6)
        return NOT_IP;
    const int64_t end = at + IPV6_BYTES + big_endian_at(data + at + 4, 2);
    int kind = data[at + 6];
    packet->key[0] = UINT64_C(6) << 32;
    for (int word = 1; word < KEY_WORDS; word++)
        packet->key[word] = (uint64_t)big_endian_at(data + at + 8 * word, 8);
    at += IPV6_BYTES;
    for (int headers = 0; headers < MOST_HEADERS; headers++) {
        if (kind == UDP)
            return read_udp(data, at, stop, packet);
        if (kind == FRAGMENT_HEADER) {
            if (at + 8 > stop)
                return TRUNCATED;
            const int64_t place = big_endian_at(data + at + 2, 2);
            kind = data[at];
            packet->key[0] = UINT64_C(6) << 32 | (uint64_t)big_endian_at(data + at + 4, 4);
            at += 8;
            /* A fragment that is the whole datagram (RFC 6946) is read like one. */
            if (!(place & ~6))
                continue;
            packet->offset = place & ~7;
            packet->more = place & 1;
            return kind == UDP ? read_part(at, end, stop, packet) : NOT_UDP;
        }
        const int is_plain = kind == HOP_BY_HOP || kind == ROUTING || kind == DESTINATION
            || kind == MOBILITY || kind == HOST_IDENTITY || kind == SHIM6;
        if (is_tunnel(kind) && at < stop)
            return read_odd(at, kind, packet);
        if (!is_plain && kind != AUTHENTICATION)
            return NOT_UDP;
        if (at + 2 > stop)
            return TRUNCATED;
        kind = data[at];
        at += is_plain ? (data[at + 1] + 1) * 8 : (data[at + 1] + 2) * 4;
    }
    return NOT_UDP;
}

/* A packet behind a link header that ends at `at`, with an ethertype, and behind VLAN tags: two
   bytes of tag, then the ethertype of the next header. */
static int read_typed(const uint8_t *data, int64_t type_at, int64_t at, int64_t stop,
                      Packet *packet)
{
    if (at > stop)
        return TRUNCATED;
    int64_t type = big_endian_at(data + type_at, 2);
    for (int tags = 0; tags < MOST_TAGS; tags++) {
        if (type != 0x8100 && type != 0x88A8 && type != 0x9100)
            break;
        if (at + 4 > stop)
            return TRUNCATED;
        type = big_endian_at(data + at + 2, 2);
        at += 4;
    }
    if (type == IPV4_TYPE)
        return read_ipv4(data, at, stop, packet);
    if ((type == PPPOE_TYPE || type == MPLS_TYPE || type == MPLS_TYPE + 1) && at < stop)
        return read_odd(at, type, packet);
    return type == IPV6_TYPE ? read_ipv6(data, at, stop, packet) : NOT_IP;
}

/* A packet that begins with its version. */
static int read_ip(const uint8_t *data, int64_t at, int64_t stop, Packet *packet)
{
    if (at == stop)
        return TRUNCATED;
    if (data[at] >> 4 == 4)
        return read_ipv4(data, at, stop, packet);
    return data[at] >> 4 == 6 ? read_ipv6(data, at, stop, packet) : NOT_IP;
}

/* A packet behind an address family of four bytes, of a host of either byte order. */
static int read_family(const uint8_t *data, int64_t at, int64_t stop, Packet *packet)
{
    if (at + 4 > stop)
        return TRUNCATED;
    const int family = data[at] | data[at + 3], is_ipv4 = family == 2;
    /* IPv6 differs with the system. */
    const int is_ipv6 = family == 10 || family == 24 || family == 28 || family == 30;
    if (data[at + 1] | data[at + 2] || !(is_ipv4 || is_ipv6))
        return NOT_IP;
    at += 4;
    if (at < stop && data[at] >> 4 != (is_ipv4 ? 4 : 6))
        return NOT_IP;
    return read_ip(data, at, stop, packet);
}

/* Link types: tcpdump.org/linktypes.html; `LINKS` of `readers/capture/frames.py`. */
static int read_frame(const uint8_t *data, int64_t at, int64_t stop, int64_t link, Packet *packet)
{
    switch (link) {
    case 1: /* Ethernet */
        return read_typed(data, at + 12, at + 14, stop, packet);
    case 113: /* Linux cooked */
        return read_typed(data, at + 14, at + 16, stop, packet);
    case 276: /* Linux cooked, 2 */
        return read_typed(data, at, at + 20, stop, packet);
    case 0: /* BSD loopback */
    case 108:
        return read_family(data, at, stop, packet);
    case 12: /* raw IP */
    case 14:
    case 101:
    case 228:
    case 229:
        return read_ip(data, at, stop, packet);
    case 9: /* PPP */
    case 50:
    case 51: /* PPP over Ethernet */
        return at < stop ? read_odd(at, -link, packet) : TRUNCATED;
    default:
        return NOT_IP;
    }
}

/* Number of the stream of a packet; a new one is the next. -1: the table is full. */
static int64_t stream_of(Dissection *all, const uint64_t *key, int64_t port)
{
    const uint64_t end = key[0] >> 32 << 16 | (uint64_t)port;
    const uint64_t golden = UINT64_C(0x9E3779B97F4A7C15);
    uint64_t slot = ((key[1] * golden ^ key[2]) * golden ^ end) * golden >> 32;
    for (;; slot++) {
        int64_t *number = all->stream_slots + slot % (uint64_t)all->slot_count;
        /* One more, so that zeros are free. */
        const int64_t at = *number ? *number - 1 : all->stream_count;
        uint64_t *stream = all->streams + STREAM_WORDS * at;
        if (!*number) {
            if (all->stream_count == all->most_streams)
                return -1;
            memcpy(stream, key + 1, 2 * sizeof *key);
            stream[2] = end;
            *number = ++all->stream_count;
        }
        if (stream[0] == key[1] && stream[1] == key[2] && stream[2] == end)
            return at;
    }
}

/* Add the datagram whose UDP header is at `at` to those found. */
static void deliver(Dissection *all, const uint8_t *data, const uint64_t *key, int64_t at,
                    int64_t host_ns)
{
    int64_t *datagram = all->datagrams + all->datagram_count++;
    datagram[0] = at + UDP_BYTES;
    datagram[all->room] = big_endian_at(data + at + 4, 2) - UDP_BYTES;
    datagram[2 * all->room] = stream_of(all, key, big_endian_at(data + at + 2, 2));
    datagram[3 * all->room] = host_ns;
}

/* -- fragments to datagrams ---------------------------------------------------------------- */

static const uint8_t *part_bytes(const Dissection *all, const uint8_t *data, int64_t part)
{
    return (all->parts[part].is_kept ? all->kept : data) + all->parts[part].start;
}

/* Remove a set, whose frames are counted as `reason`. */
static void remove_set(Dissection *all, int64_t number, int reason)
{
    FragmentSet *set = all->sets + number;
    all->skipped[reason] += set->frames;
    if (set->inherited >= 0)
        all->settled[set->inherited] = reason;
    while (set->top >= 0) {
        FragmentPart *part = all->parts + set->top;
        const int64_t below = part->below;
        if (!part->is_kept)
            all->loose_bytes -= part->size;
        all->held_bytes -= part->size;
        part->below = all->free_part;
        all->free_part = set->top;
        set->top = below;
    }
    all->set_count--;
    memmove(set, set + 1, (size_t)(all->set_count - number) * sizeof *set);
}

/* Advance the clock; remove sets that are too old. */
static void expire(Dissection *all, int64_t host_ns)
{
    const int is_other_clock = host_ns < all->now_ns - all->most_age_ns;
    if (is_other_clock || host_ns > all->now_ns)
        all->now_ns = host_ns;
    const int64_t oldest_ns = all->now_ns - all->most_age_ns;
    while (all->set_count && (is_other_clock || all->sets[0].birth_ns < oldest_ns))
        remove_set(all, 0, FRAGMENT_LOST);
}

static int64_t open_set(Dissection *all, const uint64_t *key)
{
    const size_t key_bytes = KEY_WORDS * sizeof *key;
    if (all->first_count < all->most_first) {
        int64_t number = 0;
        while (number < all->first_count
               && memcmp(all->first_keys + KEY_WORDS * number, key, key_bytes))
            number++;
        if (number == all->first_count)
            memcpy(all->first_keys + KEY_WORDS * all->first_count++, key, key_bytes);
    }
    if (all->set_count == all->most_sets)
        remove_set(all, 0, FRAGMENT_LOST);
    FragmentSet *set = all->sets + all->set_count;
    *set = (FragmentSet){.birth_ns = all->now_ns, .total = -1, .top = -1, .inherited = -1};
    memcpy(set->key, key, key_bytes);
    return all->set_count++;
}

/* Join the parts of a complete set: where the first one is, if the frames follow each other (which
   takes an eighth less CPU of a dry run), else in the front of `data`. */
static void complete(Dissection *all, uint8_t *data, int64_t number, int64_t host_ns)
{
    FragmentSet *set = all->sets + number;
    FragmentPart *parts = all->parts;
    int64_t first = -1;
    int is_row = 1;
    for (int64_t at = set->top, below; at >= 0; at = below) {
        is_row &= !parts[at].is_kept;
        if (first >= 0)
            is_row &= parts[first].frame == parts[at].frame + 1
                && parts[first].start >= parts[at].start + parts[at].size;
        below = parts[at].below;
        parts[at].below = first;
        first = at;
    }
    /* From now on the parts are in order. */
    set->top = first;
    const int64_t length =
        parts[first].size < UDP_BYTES ? 0 : big_endian_at(part_bytes(all, data, first) + 4, 2);
    if (length < UDP_BYTES || length > set->total) {
        remove_set(all, number, FRAGMENT_LOST);
        return;
    }
    const int64_t begin = is_row ? parts[first].start : all->front;
    if (!is_row)
        all->front += set->total;
    for (int64_t at = is_row ? parts[first].below : first; at >= 0; at = parts[at].below)
        memmove(data + begin + parts[at].offset, part_bytes(all, data, at),
                (size_t)parts[at].size);
    deliver(all, data, set->key, begin, host_ns);
    /* The completing frame is the datagram's. */
    set->frames--;
    remove_set(all, number, FRAGMENT);
}

/* The rules of `readers/capture/dissector.py` for one fragment. */
static void add_fragment(Dissection *all, uint8_t *data, const Packet *packet, int64_t frame,
                         int64_t host_ns)
{
    FragmentPart *parts = all->parts;
    const int64_t end = packet->offset + packet->size;
    expire(all, host_ns);
    int64_t number = all->set_count - 1;
    while (number >= 0 && memcmp(all->sets[number].key, packet->key, sizeof packet->key))
        number--;
    /* Its neighbours: `above` begins at its offset or later. */
    int64_t above = -1, below = number < 0 ? -1 : all->sets[number].top;
    for (; below >= 0 && parts[below].offset >= packet->offset; below = parts[below].below)
        above = below;
    if (above >= 0 && parts[above].offset == packet->offset) {
        FragmentSet *set = all->sets + number;
        if (parts[above].size == packet->size && packet->more == (end != set->total)
            && !memcmp(part_bytes(all, data, above), data + packet->start, (size_t)packet->size)) {
            set->frames++;
            return;
        }
        if (packet->offset == 0) {
            remove_set(all, number, FRAGMENT_LOST);
            number = above = -1;
        }
    }
    if (number < 0)
        number = open_set(all, packet->key);
    FragmentSet *set = all->sets + number;
    set->frames++;
    const int64_t limit = set->total < 0 ? MOST_DATAGRAM_BYTES : set->total;
    if (end > limit || (!packet->more && (set->total >= 0 || above >= 0))
        || (above >= 0 && parts[above].offset < end)
        || (below >= 0 && parts[below].offset + parts[below].size > packet->offset)) {
        remove_set(all, number, FRAGMENT_LOST);
        return;
    }
    const int64_t at = all->free_part >= 0 ? all->free_part : all->part_count++;
    if (at == all->free_part)
        all->free_part = parts[at].below;
    parts[at] = (FragmentPart){below, packet->offset, packet->size, packet->start, 0, frame};
    if (above >= 0)
        parts[above].below = at;
    else
        set->top = at;
    set->received += packet->size;
    all->held_bytes += packet->size;
    all->loose_bytes += packet->size;
    if (!packet->more)
        set->total = end;
    if (set->received == set->total)
        complete(all, data, number, host_ns);
}

/* Find the datagrams of frames from `first` on (first byte, captured and original length, link
   type, receive time). There is room for so many further datagrams and parts, and in the front of
   `data` for those that are joined. Return the number of the next frame: one that is odd, or
   `frames`. */
EXPORT int64_t mlbatch_dissect(Dissection *all, uint8_t *data, int64_t first, int64_t frames,
                               const int64_t *start, const int64_t *captured,
                               const int64_t *original, const int64_t *link,
                               const int64_t *host_ns)
{
    for (int64_t frame = first; frame < frames; frame++) {
        if (frame + FRAMES_AHEAD < frames) {
            const uint8_t *ahead = data + start[frame + FRAMES_AHEAD];
            __builtin_prefetch(ahead);
            __builtin_prefetch(ahead + LINE - 1);
        }
        const int64_t stop = start[frame] + captured[frame];
        Packet packet;
        int verdict = read_frame(data, start[frame], stop, link[frame], &packet);
        if (verdict >= WHOLE && captured[frame] < original[frame])
            verdict = TRUNCATED;
        /* The next frame is likely to be copied, too. */
        if (verdict == PART && frame + 1 < frames)
            for (int64_t line = 0; line < captured[frame + 1]; line += LINE)
                __builtin_prefetch(data + start[frame + 1] + line);
        if (verdict == WHOLE)
            deliver(all, data, packet.key, packet.start, host_ns[frame]);
        else if (verdict == PART)
            add_fragment(all, data, &packet, frame, host_ns[frame]);
        else if (verdict != ODD)
            all->skipped[verdict]++;
        else {
            all->odd_at = packet.start;
            all->odd_kind = packet.kind;
            return frame;
        }
    }
    return frames;
}

/* Copy the parts that are in `data`, or all, to `kept` from byte `used` on; return the first free
   byte. */
EXPORT int64_t mlbatch_keep(Dissection *all, const uint8_t *data, int64_t copies_all, uint8_t *kept,
                            int64_t used)
{
    for (int64_t number = 0; number < all->set_count; number++)
        for (int64_t at = all->sets[number].top; at >= 0; at = all->parts[at].below) {
            FragmentPart *part = all->parts + at;
            if (part->is_kept && !copies_all)
                continue;
            memcpy(kept + used, part_bytes(all, data, at), (size_t)part->size);
            part->start = used;
            part->is_kept = 1;
            used += part->size;
        }
    all->kept = kept;
    all->loose_bytes = 0;
    return used;
}

/* Copy source[source_at[i] : + bytes[i]] to target[target_at[i] : ...] for all i; source and
   target may be parts of one buffer, runs do not overlap. */
EXPORT void mlbatch_copy(int64_t runs, const uint8_t *source, const int64_t *source_at,
                         const int64_t *bytes, uint8_t *target, const int64_t *target_at)
{
    for (int64_t run = 0; run < runs; run++)
        memmove(target + target_at[run], source + source_at[run], (size_t)bytes[run]);
}

static uint64_t word8(const uint8_t *at)
{
    uint64_t value;
    memcpy(&value, at, sizeof value);
    return value;
}

/* Sum of the 64-bit words of `bytes` bytes, modulo 2^64, without those of an incomplete word. */
static uint64_t sum_words(const uint8_t *from, int64_t bytes)
{
    uint64_t sum = 0;
    for (int64_t at = 0; at + 8 <= bytes; at += 8)
        sum += word8(from + at);
    return sum;
}

/* Sums of the 64-bit words of packets, modulo 2^64; the last word overlaps the one before where
   the bytes are no whole words. Packets of less than a word: sums of bytes. */
EXPORT void mlbatch_sums(int64_t packets, const uint8_t *data, const int64_t *start, int64_t bytes,
                         uint64_t *sums)
{
    for (int64_t packet = 0; packet < packets; packet++) {
        const uint8_t *from = data + start[packet];
        /* Packets of other sensors are in between: no processor expects the next one. */
        const uint8_t *next = data + start[packet + 1 < packets ? packet + 1 : packet];
        uint64_t sum = 0;
        int64_t line = 0;
        for (; line + LINE <= bytes; line += LINE) {
            __builtin_prefetch(next + line);
            sum += sum_words(from + line, LINE);
        }
        sum += sum_words(from + line, bytes - line);
        if (bytes < 8)
            for (int64_t at = 0; at < bytes; at++)
                sum += from[at];
        else if (bytes % 8)
            sum += word8(from + bytes - 8);
        sums[packet] = sum;
    }
}

EXPORT int64_t mlbatch_abi(void)
{
    return MLBATCH_ABI;
}
