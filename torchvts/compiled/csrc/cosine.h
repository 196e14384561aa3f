/* Cosine transforms of many lines at once: see cosine.c. */
#ifndef TORCHVTS_COSINE_H
#define TORCHVTS_COSINE_H

#include "kernels.h"

enum { LANES = 16, LINES = 2 * LANES, MOST_PASSES = 32, MOST_RADIX = 64 };

/* Tables for lines of n values, all in one block of memory. */
typedef struct {
    int n, passes, radix[MOST_PASSES];
    const float *turns;    /* cos and sin of pi k / 2n, for k up to n / 2 */
    const float *twiddles; /* of all passes */
} Cosine;

int cosine_radices(int n, int *radix);
size_t cosine_table_size(int n);
void make_cosine_tables(int n, float *tables);
Cosine cosine_of(int n, const float *tables);
size_t cosine_scratch_size(int n);
void cosine_forward(const Cosine *of, float *scratch, float *found);
void cosine_inverse(const Cosine *of, const float *coefficients, float *scratch, float *lines);
float *cosine_line(const Cosine *of, float *scratch, int y);

#endif
