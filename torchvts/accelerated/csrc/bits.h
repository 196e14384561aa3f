/* Masks of coarse cells, a bit each: see bits.c. */
#ifndef TORCHVTS_BITS_H
#define TORCHVTS_BITS_H

#include "kernels.h"

/* Rows of a mask, each of so many words, the first column in the lowest bit of the first word; bits beyond the last column are zero. */
typedef struct {
    int rows, columns, words;
    uint64_t last; /* the bits of a row's last word */
} Shape;

Shape shape_of(int rows, int columns);
size_t words_of(const Shape *shape);
void pack_bits(const uint8_t *bytes, const Shape *shape, uint64_t *row);
void unpack_bits(const uint64_t *row, const Shape *shape, uint8_t *bytes);
void invert_bits(const uint64_t *mask, const Shape *shape, uint64_t *result);
void flood(uint64_t *reached, const uint64_t *open, const Shape *shape);
void flood_from_border(const uint64_t *open, const Shape *shape, uint64_t *reached);
void widen(const uint64_t *mask, const Shape *shape, int reach, uint64_t *scratch, uint64_t *result);

#endif
