/* Masks of coarse cells, a bit each: 64 cells are looked at at once. */
#include "bits.h"

Shape shape_of(int rows, int columns) {
    const int words = (columns + 63) / 64, left = columns - 64 * (words - 1);
    const Shape shape = {rows, columns, words, left == 64 ? ~UINT64_C(0) : (UINT64_C(1) << left) - 1};
    return shape;
}

/* Words of a mask. */
size_t words_of(const Shape *shape) { return (size_t)shape->rows * shape->words; }

/* The lowest bits of eight bytes, the first lowest: a product moves them all at once where the first byte is the lowest of a word. */
static inline uint64_t gathered(const uint8_t *bytes) {
    uint64_t eight = 0;
    for (int k = 0; k < 8; k++) eight |= (uint64_t)bytes[k] << (8 * k); /* one load */
    return (eight & UINT64_C(0x0101010101010101)) * UINT64_C(0x0102040810204080) >> 56;
}

/* The inverse. */
static inline void scatter(uint64_t bits, uint8_t *bytes) {
    const uint64_t one_each = (bits * UINT64_C(0x0101010101010101)) & UINT64_C(0x8040201008040201);
    const uint64_t ones = ((one_each + UINT64_C(0x00406070787c7e7f)) & UINT64_C(0x8080808080808080)) >> 7;
    for (int k = 0; k < 8; k++) bytes[k] = (uint8_t)(ones >> (8 * k));
}

/* A row of ones and zeros, bytes, to bits; of as many bytes as its words have bits, which need not be set beyond the last column. */
void pack_bits(const uint8_t *bytes, const Shape *shape, uint64_t *row) {
    for (int w = 0; w < shape->words; w++, bytes += 64) {
        uint64_t word = 0;
        for (int k = 0; k < 64; k += 8) word |= gathered(bytes + k) << k;
        row[w] = word;
    }
    row[shape->words - 1] &= shape->last;
}

/* The inverse; all bytes of the words are written. */
void unpack_bits(const uint64_t *row, const Shape *shape, uint8_t *bytes) {
    for (int w = 0; w < shape->words; w++, bytes += 64)
        for (int k = 0; k < 64; k += 8) scatter(row[w] >> k & 0xff, bytes + k);
}

void invert_bits(const uint64_t *mask, const Shape *shape, uint64_t *result) {
    for (int y = 0; y < shape->rows; y++)
        for (int w = 0; w < shape->words; w++)
            result[y * shape->words + w] = ~mask[y * shape->words + w] & (w == shape->words - 1 ? shape->last : ~UINT64_C(0));
}

/* Bits of a word that are connected, within `open`, to those that are set (Kogge and Stone's prefixes, IEEE Trans. Computers C-22(8), 1973). */
static inline uint64_t along(uint64_t set, uint64_t open) {
    uint64_t up = open, down = open;
    for (int k = 1; k < 64; k *= 2) {
        set |= up & set << k, up &= up << k;
        set |= down & set >> k, down &= down >> k;
    }
    return set;
}

/* The same of a row, after what its neighbour has reached; returns whether that was more. */
static int flood_row(uint64_t *row, const uint64_t *neighbour, const uint64_t *open, int words) {
    uint64_t more = 0;
    for (int w = 0; w < words; w++) {
        const uint64_t before = row[w], carried = w > 0 ? row[w - 1] >> 63 : 0;
        const uint64_t seeds = before | ((neighbour[w] | carried) & open[w]);
        if (seeds != before) row[w] = along(seeds, open[w]);
        more |= row[w] ^ before;
    }
    for (int w = words - 2; w >= 0; w--) {
        const uint64_t seed = row[w + 1] << 63 & open[w] & ~row[w];
        if (seed) row[w] = along(row[w] | seed, open[w]), more = 1;
    }
    return more != 0;
}

/* Reached bits, all of them open, grow over the edges of cells to all open ones that are connected to them. */
void flood(uint64_t *reached, const uint64_t *open, const Shape *shape) {
    const int rows = shape->rows, words = shape->words;
    for (int y = 0; y < rows; y++) { /* each row in itself: later only what comes from a neighbour is new */
        uint64_t *row = reached + y * words;
        for (int w = 0; w < words; w++) row[w] = along(row[w], open[y * words + w]);
        flood_row(row, row, open + y * words, words);
    }
    for (int more = 1; more;) {
        more = 0;
        for (int y = 1; y < rows; y++) more |= flood_row(reached + y * words, reached + (y - 1) * words, open + y * words, words);
        for (int y = rows - 2; y >= 0; y--) more |= flood_row(reached + y * words, reached + (y + 1) * words, open + y * words, words);
    }
}

/* Open cells that are connected to the border of the mask. */
void flood_from_border(const uint64_t *open, const Shape *shape, uint64_t *reached) {
    const int rows = shape->rows, words = shape->words;
    for (int y = 0; y < rows; y++)
        for (int w = 0; w < words; w++) {
            uint64_t border = y == 0 || y == rows - 1 ? ~UINT64_C(0) : 0;
            if (w == 0) border |= 1;
            if (w == words - 1) border |= shape->last ^ shape->last >> 1;
            reached[y * words + w] = border & open[y * words + w];
        }
    flood(reached, open, shape);
}

/* Bits of a row within `reach` columns of one that is set: shifts by 1, 2, 4 and so on, and what is left. */
static void widen_row(const uint64_t *row, const Shape *shape, int reach, uint64_t *result) {
    const int words = shape->words;
    memcpy(result, row, sizeof(uint64_t) * (size_t)words);
    for (int done = 0; done < reach;) {
        const int by = least(least(done + 1, reach - done), 63);
        uint64_t before = 0;
        for (int w = 0; w < words; w++) {
            const uint64_t here = result[w], next = w + 1 < words ? result[w + 1] : 0;
            result[w] = here | here << by | before >> (64 - by) | here >> by | next << (64 - by);
            before = here;
        }
        done += by;
    }
    result[words - 1] &= shape->last;
}

/* A mask dilated by a square of `reach` cells either way. scratch: a mask. */
void widen(const uint64_t *mask, const Shape *shape, int reach, uint64_t *scratch, uint64_t *result) {
    const int rows = shape->rows, words = shape->words;
    for (int y = 0; y < rows; y++) widen_row(mask + y * words, shape, reach, scratch + y * words);
    memset(result, 0, sizeof(uint64_t) * words_of(shape));
    for (int y = 0; y < rows; y++)
        for (int k = y > reach ? y - reach : 0; k <= y + reach && k < rows; k++)
            for (int w = 0; w < words; w++) result[y * words + w] |= scratch[k * words + w];
}
