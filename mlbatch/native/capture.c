/* Captures: records of a pcap file to frames, frames to datagrams and fragments.

   Layouts: draft-ietf-opsawg-pcap, section 5; RFC 791 (IPv4); RFC 768 (UDP). The same verdicts as
   `readers/capture/frames.py`, to which everything unusual is left. */
#include <string.h>

#include "native.h"

#if defined(__SSE2__)
#include <emmintrin.h>
#endif

enum { RECORD_BYTES = 16, ETHERNET_BYTES = 14, IP_BYTES = 20, UDP_BYTES = 8 };
enum { IPV4_TYPE = 0x0800, UDP = 17, MORE_FRAGMENTS = 0x2000, FRAGMENT_OFFSET = 0x1FFF };
/* Why a walk ends: `native/capture.py`. */
enum { NO_ROOM, CUT, TOO_LONG };
/* Headers of so many frames ahead are asked for: what was just read is in no near cache. */
enum { FRAMES_AHEAD = 4 };

static int64_t low(const uint8_t *byte)
{
    return byte[0] | byte[1] << 8 | byte[2] << 16 | (int64_t)byte[3] << 24;
}

static int64_t high(const uint8_t *byte)
{
    return (int64_t)byte[0] << 24 | byte[1] << 16 | byte[2] << 8 | byte[3];
}

static int64_t high2(const uint8_t *byte)
{
    return byte[0] << 8 | byte[1];
}

static int64_t word(const uint8_t *byte, int64_t is_swapped)
{
    return is_swapped ? high(byte) : low(byte);
}

/* Ask for a line of 64 bytes. */
static void prefetch(const uint8_t *at)
{
#if defined(__SSE2__)
    _mm_prefetch((const char *)at, _MM_HINT_T0);
#else
    (void)at;
#endif
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
        const int64_t size = word(record + 8, is_swapped);
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
            prefetch(data + ahead);
        columns[count] = place + RECORD_BYTES;
        columns[room + count] = size;
        columns[2 * room + count] = word(record + 12, is_swapped);
        columns[3 * room + count] =
            word(record, is_swapped) * INT64_C(1000000000) + word(record + 4, is_swapped) * unit_ns;
        place += RECORD_BYTES + size;
    }
    stop[0] = place;
    stop[1] = why;
    return count;
}

/* A whole datagram: frame, first byte, size, source address, destination port. */
static int add_datagram(const uint8_t *data, int64_t frame, int64_t packet, int64_t body,
                        int64_t stop, int64_t room, int64_t *out)
{
    const int64_t size = high2(data + body + 4);
    if (size < UDP_BYTES || body + size > stop)
        return 0;
    out[0] = frame;
    out[room] = body + UDP_BYTES;
    out[2 * room] = size - UDP_BYTES;
    out[3 * room] = high(data + packet + 12);
    out[4 * room] = high2(data + body + 2);
    return 1;
}

/* A fragment: frame, source, destination, identification, offset, more follow, first byte, size. */
static int add_fragment(const uint8_t *data, int64_t frame, int64_t packet, int64_t body,
                        int64_t stop, int64_t room, int64_t *out)
{
    const int64_t end = packet + high2(data + packet + 2), place = high2(data + packet + 6);
    if (end <= body || end > stop)
        return 0;
    out[0] = frame;
    out[room] = high(data + packet + 12);
    out[2 * room] = high(data + packet + 16);
    out[3 * room] = high2(data + packet + 4);
    out[4 * room] = (place & FRAGMENT_OFFSET) * 8;
    out[5 * room] = (place & MORE_FRAGMENTS) != 0;
    out[6 * room] = body;
    out[7 * room] = end - body;
    return 1;
}

/* Frames of Ethernet, IPv4 and UDP to datagrams (5, frames) and fragments (8, frames); others:
   numbers of all other frames. Return the number of datagrams; found: fragments, others. */
EXPORT int64_t mlbatch_dissect(const uint8_t *data, int64_t data_bytes, int64_t frames,
                               const int64_t *start, const int64_t *captured,
                               const int64_t *original, int64_t *datagrams, int64_t *fragments,
                               int64_t *others, int64_t *found)
{
    int64_t whole = 0, parts = 0, rest = 0;
    for (int64_t frame = 0; frame < frames; frame++) {
        const int64_t first = start[frame], size = captured[frame];
        const int is_inside = first >= 0 && size >= ETHERNET_BYTES + IP_BYTES + UDP_BYTES
            && first <= data_bytes && size <= data_bytes - first && original[frame] <= size;
        int is_usual = 0;
        if (is_inside) {
            const int64_t packet = first + ETHERNET_BYTES, stop = first + size;
            const int64_t body = packet + (data[packet] & 15) * 4;
            const int is_udp = high2(data + first + 12) == IPV4_TYPE && data[packet] >> 4 == 4
                && data[packet + 9] == UDP && packet + IP_BYTES <= body && body + UDP_BYTES <= stop;
            if (is_udp && (high2(data + packet + 6) & (MORE_FRAGMENTS | FRAGMENT_OFFSET))) {
                is_usual =
                    add_fragment(data, frame, packet, body, stop, frames, fragments + parts);
                parts += is_usual;
            } else if (is_udp) {
                is_usual =
                    add_datagram(data, frame, packet, body, stop, frames, datagrams + whole);
                whole += is_usual;
            }
        }
        if (!is_usual)
            others[rest++] = frame;
    }
    found[0] = parts;
    found[1] = rest;
    return whole;
}

enum { FRAME, SOURCE, DESTINATION, IDENT, OFFSET, MORE, START, SIZE };
enum { MOST_DATAGRAM_BYTES = 65535 };

/* Join the fragments (8, count) of datagrams whose frames follow each other: each part is moved
   down to the end of the one before. All others are left as they are, also those of a set
   (source, destination, identification) that has other fragments before: sets (room, 3) begins
   with the set_count open ones and takes those found. receive_ns (count) rises. Return the number
   of datagrams (5, count); rest: numbers of the fragments that are left, rest_count of them. */
EXPORT int64_t mlbatch_join(uint8_t *data, int64_t count, const int64_t *fragments,
                            const int64_t *receive_ns, int64_t most_ns, int64_t set_count,
                            int64_t room, int64_t *sets, int64_t *datagrams, int64_t *rest,
                            int64_t *rest_count)
{
    const int64_t *column[SIZE + 1];
    for (int one = 0; one <= SIZE; one++)
        column[one] = fragments + one * count;
    const int64_t *offset = column[OFFSET], *start = column[START], *size = column[SIZE];
    int64_t whole = 0, left = 0;
    for (int64_t first = 0, next; first < count; first = next) {
        for (next = first + 1; next < count && column[MORE][next - 1]; next++) {
            int follows = column[FRAME][next] == column[FRAME][next - 1] + 1
                && offset[next] == offset[next - 1] + size[next - 1]
                && start[next] >= start[next - 1] + size[next - 1];
            for (int key = SOURCE; key <= IDENT; key++)
                follows &= column[key][next] == column[key][first];
            if (!follows)
                break;
        }
        const int64_t last = next - 1, total = offset[last] + size[last];
        const int64_t length = size[first] < UDP_BYTES ? 0 : high2(data + start[first] + 4);
        int is_whole = offset[first] == 0 && !column[MORE][last] && total <= MOST_DATAGRAM_BYTES
            && length >= UDP_BYTES && length <= total
            && receive_ns[last] - receive_ns[first] <= most_ns && set_count < room;
        for (int64_t set = 0; set < set_count && is_whole; set++)
            is_whole = sets[3 * set] != column[SOURCE][first]
                || sets[3 * set + 1] != column[DESTINATION][first]
                || sets[3 * set + 2] != column[IDENT][first];
        if (is_whole) {
            const int64_t begin = start[first];
            for (int64_t part = first + 1; part < next; part++)
                memmove(data + begin + offset[part], data + start[part], (size_t)size[part]);
            int64_t *out = datagrams + whole++;
            out[0] = column[FRAME][last];
            out[count] = begin + UDP_BYTES;
            out[2 * count] = length - UDP_BYTES;
            out[3 * count] = column[SOURCE][first];
            out[4 * count] = high2(data + begin + 2);
            continue;
        }
        for (int64_t part = first; part < next; part++)
            rest[left++] = part;
        if (set_count < room) {
            for (int key = 0; key < 3; key++)
                sets[3 * set_count + key] = column[SOURCE + key][first];
            set_count++;
        }
    }
    *rest_count = left;
    return whole;
}

/* Copy source[source_at[i] : + bytes[i]] to target[target_at[i] : ...] for all i; source and
   target may be parts of one buffer, runs do not overlap. */
EXPORT void mlbatch_copy(int64_t runs, const uint8_t *source, const int64_t *source_at,
                         const int64_t *bytes, uint8_t *target, const int64_t *target_at)
{
    for (int64_t run = 0; run < runs; run++)
        memmove(target + target_at[run], source + source_at[run], (size_t)bytes[run]);
}

/* Copy the bytes of ranges (ranges, 2: first byte, bytes) of packets to the same bytes of the rows
   of `out`, row_bytes apart. */
EXPORT void mlbatch_gather(int64_t packets, const uint8_t *data, const int64_t *start,
                           int64_t range_count, const int64_t *ranges, int64_t row_bytes,
                           uint8_t *out)
{
    for (int64_t packet = 0; packet < packets; packet++, out += row_bytes) {
        const uint8_t *from = data + start[packet];
        for (int64_t range = 0; range < range_count; range++)
            memcpy(out + ranges[2 * range], from + ranges[2 * range],
                   (size_t)ranges[2 * range + 1]);
    }
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
    enum { LINE = 64 };
    for (int64_t packet = 0; packet < packets; packet++) {
        const uint8_t *from = data + start[packet];
        /* Packets of other sensors are in between: no processor expects the next one. */
        const uint8_t *next = data + start[packet + 1 < packets ? packet + 1 : packet];
        uint64_t sum = 0;
        int64_t line = 0;
        for (; line + LINE <= bytes; line += LINE) {
            prefetch(next + line);
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
